"""The imports run one way, and `import kcs_torch` stays light."""

import ast
import json
import pickle
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "kcs_torch"

# What each part may import of the package; "errors" is open to all.
BASE = {"anatomy", "skeleton", "types"}
ALLOWED = {
    "errors": set(),
    "anatomy": set(),
    "skeleton": {"anatomy"},
    "functional": set(),
    "types": {"functional", "skeleton"},
    "solvers": {"functional"},
    "nn": {"functional", "solvers"} | BASE,
    "methods": {"functional", "solvers", "nn", "clean"} | BASE,
    "metrics": {"functional"} | BASE,
    "clean": {"functional", "solvers", "nn"} | BASE,
    "data": {"functional"} | BASE,
    "detect": {"io"} | BASE,
    "viewer": {"functional", "metrics"} | BASE,
    "io": {"functional", "viewer"} | BASE,
    "reconstruct": {"functional", "solvers", "nn", "methods"} | BASE,
    "live": {"functional", "solvers", "nn", "methods"} | BASE,
    "training": {"functional", "solvers", "nn", "methods", "metrics", "clean", "data", "io"} | BASE,
    "cli": {
        "",
        "functional",
        "methods",
        "reconstruct",
        "io",
        "data",
        "viewer",
        "metrics",
        "clean",
        "detect",
        "training",
    }
    | BASE,
    "__main__": {"cli"},
    "many": {"io", "methods", "reconstruct"} | BASE,
    "": {"functional", "solvers", "nn", "methods", "reconstruct", "live", "io", "metrics"} | BASE,
}
# The folders and files of a part from the bottom up: each imports those before it only. "*" are those not named.
ORDER = {
    "methods": ["clips", "answer", "base", "factorised", "sfam", "*", "perspective", "__init__"],
    "io": ["folders", "registry", "workers", "containers", "contents", "tables", "formats", "*", "__init__"],
}
# Imports made only when called, against the direction: a convenience of the object that the user holds.
LATE = {("types", "io")}

# Who may import a package that is slow to load or not part of the core installation.
OUTSIDE = {
    "lightning": {"training"},
    "hydra": {"training"},
    "omegaconf": {"training"},
    "torchmetrics": {"metrics", "training"},
    "matplotlib": {"viewer"},
    "PIL": {"viewer"},
    "imageio_ffmpeg": {"viewer"},
    "rerun": {"viewer"},
    "scipy": {"clean", "data", "io"},
    "typer": {"cli"},
    "rich": {"cli"},
    "yaml": {"skeleton", "cli"},
    "triton": {"functional"},
    "joblib": {"methods"},
}


def part(path: Path) -> str:
    """The first-level part of the package that a file belongs to; '' for the package itself."""
    first = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    return "" if first == "__init__" else first


def imports(path: Path):
    """Yield (dotted name, line, whether inside a function) of every import in a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    late = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef))
        for node in ast.walk(function)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if node.level:
                folder = path.relative_to(ROOT).parts[: -node.level]
                module = ".".join([*folder, *([module] if module else [])])
            names = [f"{module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            yield name, node.lineno, id(node) in late


FILES = sorted(PACKAGE.rglob("*.py"))


def test_every_part_has_a_place():
    unplaced = {part(f) for f in FILES} - set(ALLOWED)
    assert not unplaced, f"say in ALLOWED what {unplaced} may import"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_run_one_way(path):
    own = part(path)
    wrong = []
    for name, line, late in imports(path):
        words = name.split(".")
        if words[0] == "kcs_torch":
            other = words[1] if len(words) > 1 else ""
            if not (PACKAGE / other).is_dir() and not (PACKAGE / f"{other}.py").exists():
                other = ""  # a public name, taken from the package itself
            allowed = other in ALLOWED[own] | {own, "errors"} or (late and (own, other) in LATE)
        else:
            allowed = words[0] not in OUTSIDE or own in OUTSIDE[words[0]]
        if not allowed:
            wrong.append(f"{path.relative_to(ROOT)}:{line} imports {name}")
    assert not wrong, "\n".join(wrong)


def imported_anyway(path: Path):
    """Names that importing a file imports: not those in functions, nor those for type checkers."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    typed = {
        node.lineno
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in block.body
    }
    return [name for name, line, late in imports(path) if not late and line not in typed]


@pytest.mark.parametrize("name", ORDER)
def test_folders_of_a_part_import_one_way(name):
    order = ORDER[name]
    known = {path.name.removesuffix(".py") for path in (PACKAGE / name).iterdir()}
    assert set(order) - {"*"} <= known

    def height(first: str) -> int:
        return order.index(first if first in order else "*")

    for path in sorted((PACKAGE / name).rglob("*.py")):
        own = path.relative_to(PACKAGE / name).parts[0].removesuffix(".py")
        for other in imported_anyway(path):
            words = other.split(".")
            if words[:2] == ["kcs_torch", name] and len(words) > 2 and words[2] in known - {own}:
                assert height(words[2]) <= height(own), f"{path.relative_to(ROOT)} imports {other}"


@pytest.mark.parametrize("name", ["pkc", "perspective"])
def test_folders_of_many_files_say_what_each_is_for(name):
    """In the docstring of the package, which is where a reader begins."""
    folder = PACKAGE / "methods" / name
    told = re.findall(r"``(\w+)``", ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))))
    assert sorted(told) == sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")


def test_functional_needs_torch_only():
    """And Triton for its one kernel, which is imported where a GPU asks for it."""
    for path in (PACKAGE / "functional").glob("*.py"):
        outside = {name.split(".")[0] for name, _, _ in imports(path)} - sys.stdlib_module_names
        kernel = path.name == "jacobi.py"
        assert outside == {"torch", "triton"} if kernel else outside <= {"torch", "kcs_torch"}, path
        assert all(late for name, _, late in imports(path) if name.startswith("kcs_torch.functional.jacobi")), path


def test_every_outside_package_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needs = [*project["dependencies"], *(n for extra in project["optional-dependencies"].values() for n in extra)]
    declared = {re.match(r"[\w-]+", need).group(0).lower() for need in needs}
    named = {"yaml": "pyyaml", "hydra": "hydra-core", "mpl_toolkits": "matplotlib", "PIL": "pillow"}
    named |= {"imageio_ffmpeg": "imageio-ffmpeg", "rerun": "rerun-sdk", "omegaconf": "hydra-core"}
    for path in FILES:
        outside = {name.split(".")[0] for name, _, _ in imports(path)} - sys.stdlib_module_names - {"kcs_torch"}
        assert {named.get(n, n) for n in outside} <= declared, path


def loaded(code: str) -> set[str]:
    """Names of the top-level modules that a fresh interpreter has after running ``code``."""
    code += "\nimport json, sys; print(json.dumps(sorted({name.split('.')[0] for name in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_import_is_light():
    code = "import kcs_torch as kt\nfor name in kt.__all__: getattr(kt, name)"
    names = loaded(code)
    assert "torch" in names  # the names were really loaded
    assert not names & {
        "lightning",
        "hydra",
        "joblib",
        "plotly",
        "scipy",
        "matplotlib",
        "yaml",
        "typer",
        "rich",
        "torchmetrics",
    }


def test_modules_and_methods_do_without_the_compiler_of_torch():
    """It takes a second to load."""
    code = "import sys, kcs_torch.nn, kcs_torch.methods, kcs_torch.io"
    assert "kcs_torch" in loaded(f"{code}\nassert 'torch._dynamo' not in sys.modules")


def test_command_line_loads_without_torch():
    names = loaded("import kcs_torch.cli")
    assert "typer" in names
    assert not names & {"torch", "numpy", "scipy", "plotly", "matplotlib", "yaml"}


def test_help_loads_without_torch():
    code = (
        "import sys; sys.argv = ['kcs-torch', '--help']\n"
        "from kcs_torch.cli import main\n"
        "try: main()\nexcept SystemExit as end: assert not end.code, end.code"
    )
    assert not loaded(code) & {"torch", "numpy"}


def test_every_module_with_a_page_is_an_attribute_of_the_package():
    pages = re.findall(r"^api/(\w+)$", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    code = "import kcs_torch as kt\nfor name in {}: getattr(kt, name)"
    loaded(code.format([name for name in pages if name != "kcs_torch"]))


def test_public_names_exist_and_are_listed():
    import kcs_torch as kt

    assert sorted(kt.__all__) == sorted(set(kt.__all__))
    assert set(kt.__all__) <= set(dir(kt)) and not {"importlib", "sys", "Any"} & set(dir(kt))
    for name in kt.__all__:
        assert getattr(kt, name) is not None
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = kt.no_such_name


def test_typed_names_are_the_public_names():
    """The names that type checkers see are those that exist at run time."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    block = next(n for n in tree.body if isinstance(n, ast.If))
    typed = {alias.name for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    import kcs_torch as kt

    assert typed == set(kt.__all__)


def test_importing_a_submodule_does_not_hide_a_function():
    code = (
        "import kcs_torch.reconstruct, kcs_torch as kt\n"
        "assert callable(kt.reconstruct) and kt.reconstruct.__name__ == 'reconstruct'"
    )
    assert "torch" in loaded(code)


def test_the_package_goes_to_other_processes_by_its_name():
    """Launchers of jobs pickle what a script's functions use, and that is the package."""
    import kcs_torch as kt

    assert pickle.loads(pickle.dumps(kt)) is kt


def test_version_is_that_of_the_project():
    import kcs_torch as kt

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert kt.__version__ == project["version"]
    assert f"version: {project['version']}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
