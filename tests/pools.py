"""The processes that joblib keeps for all who ask for some: they stay in the folder where they were started."""

import pytest


def end_pool() -> None:
    loky = pytest.importorskip("joblib.externals.loky")
    loky.get_reusable_executor(reuse=True).shutdown(wait=True)
