"""Train a lifting network, with 3D labels or without.

    python scripts/train.py
    python scripts/train.py data=cmu model=mlp loss=hybrid trainer=gpu data.labelled=0.05
    python scripts/train.py resume=outputs/train/2025-01-31_12-00-00
    python scripts/train.py -m model=mlp,temporal seed=0,1 hydra/launcher=joblib
    python scripts/train.py -m hydra/sweeper=optuna hydra.sweeper.n_trials=20 \
        'module.lr=tag(log,interval(1e-4,1e-2))' 'loss=supervised,hybrid'

The groups and all settings: --help. A run's folder under ``outputs/train`` holds the logs (``csv``, ``tensorboard``),
the ``checkpoints`` of the best and the last epoch, ``result.json``, and ``lifter.safetensors``, which
``kcs_torch.training.load_lifter`` reads; a sweep's folder holds ``results.csv``. ``kcs-torch train`` does the same.
"""

from __future__ import annotations

from kcs_torch.training.run import main

if __name__ == "__main__":
    main()
