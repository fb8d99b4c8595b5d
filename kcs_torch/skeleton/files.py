"""Skeletons as plain mappings, which YAML and JSON files hold."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcs_torch.errors import FormatError, unknown

if TYPE_CHECKING:
    from kcs_torch.anatomy import Hinge
    from kcs_torch.skeleton.core import Skeleton

__all__ = ["as_mapping", "check_mapping", "read_mapping"]

KEYS = (
    *("name", "joints", "bones", "mirror", "virtual", "template", "proportions", "flexible", "tree"),
    *("hinges", "contacts", "spread"),
)


def read_mapping(path: Path) -> Any:
    """What a YAML or JSON file holds; a skeleton without a name has that of the file.

    Raises:
        FormatError: the file cannot be read, or is neither.
    """
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
        data = json.loads(text, object_pairs_hook=_once) if path.suffix.lower() == ".json" else _yaml(text)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        message = f"{path}: expected a YAML or JSON skeleton, got text that does not parse: {error}"
        raise FormatError(message) from None
    if isinstance(data, dict):
        data.setdefault("name", path.stem)
    return data


def _yaml(text: str) -> Any:
    import yaml

    class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # in C it is several times faster
        """Refuses a key that is there twice, of which YAML would take the last."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            _once([(key.value, None) for key, _ in node.value if isinstance(key, yaml.ScalarNode)])
            return super().construct_mapping(node, deep)

    return yaml.load(text, Loader=Loader)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The mapping of these pairs.

    Raises:
        ValueError: a key is there twice.
    """
    counts = Counter(key for key, _ in pairs)
    if len(counts) < len(pairs):
        raise ValueError(f"'{counts.most_common(1)[0][0]}' is there twice")
    return dict(pairs)


def check_mapping(data: Any, source: str) -> dict[str, Any]:
    """The arguments of ``Skeleton.from_names`` that a mapping holds; None under a key is none.

    Raises:
        FormatError: a key is unknown or missing, or a value has the wrong type.
    """
    if not isinstance(data, Mapping):
        raise FormatError(f"{source}: expected a mapping with 'joints' and 'bones', got {type(data).__name__}")
    for key in data:
        if key not in KEYS:
            raise unknown(f"key in {source}", key, KEYS, FormatError)
    for key in ("joints", "bones"):
        if not isinstance(data.get(key), (list, tuple)):
            raise FormatError(f"{source}: expected a list under '{key}', got {type(data.get(key)).__name__}")
    for key, kind in (("name", str), ("tree", bool)):
        if not isinstance(data.get(key), (kind, type(None))):
            raise FormatError(f"{source}: {key}: expected a {kind.__name__}, got {data[key]!r}")
    return {key: value for key, value in data.items() if value is not None}


def as_mapping(body: Skeleton) -> dict[str, Any]:
    """A skeleton as plain lists and mappings, which :func:`check_mapping` takes."""
    out: dict[str, Any] = {"name": body.name, "joints": list(body.joints[: body.num_observed])}
    if body.virtual:
        out["virtual"] = {body.joints[v]: [body.joints[s] for s in sources] for v, sources in body.virtual}
    out["bones"] = [[body.joints[a], body.joints[b]] for a, b in body.bones]
    out["mirror"] = [[body.joints[a], body.joints[b]] for a, b in body.mirror]
    if body.flexible:
        out["flexible"] = [out["bones"][i][:] for i in body.flexible]
    if body.template is not None:
        out["template"] = {j: list(p) for j, p in zip(body.joints, body.template, strict=True)}
    if body.proportions is not None:
        out["proportions"] = dict(zip(body.bone_names, body.proportions, strict=True))
    if not body.tree:
        out["tree"] = False
    out["hinges"] = [_hinge(h, body.joints) for h in body.hinges]
    out["contacts"] = [body.joints[i] for i in body.contacts]
    if body.template is not None or body.spread is not None:
        out["spread"] = dict(zip(body.bone_names, body.spread or (), strict=False))
    return out


def _hinge(hinge: Hinge, names: Sequence[str]) -> dict[str, Any]:
    """The keys that ``Skeleton.from_names`` takes for a hinge, all of them."""
    return {
        "joint": names[hinge.joint],
        "bends": hinge.bends,
        "axis": [names[hinge.left], names[hinge.right]],
        "weight": hinge.firm,
        "parent": names[hinge.parent],
        "child": names[hinge.child],
    }
