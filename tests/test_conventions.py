"""Conventions of the code: style, types, docstrings, public names, imports."""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
from numpydoc.validate import validate

import isa_nrsfm

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "isa_nrsfm"
TESTS = ROOT / "tests"
FOLDERS = ["isa_nrsfm", "tests", "benchmarks", "docs"]
MODULES = [
    module.name for module in pkgutil.walk_packages(isa_nrsfm.__path__, "isa_nrsfm.")
]
# Where everybody finds names; each has __all__.
PUBLIC_MODULES = ["isa_nrsfm", *(name for name in MODULES if "._" not in name)]
# Not every docstring needs an extended summary, a See Also section or an example.
NOT_NEEDED = {"ES01", "SA01", "EX01"}


def public_objects():
    """Return the public classes and functions by where they are found first."""
    objects = {}
    for module in PUBLIC_MODULES:
        for name in importlib.import_module(module).__all__:
            item = getattr(sys.modules[module], name)
            if inspect.isclass(item) or inspect.isfunction(item):
                objects.setdefault(item, f"{module}.{name}")
    return {path: item for item, path in objects.items()}


def documented_names():
    """Return the public objects and the public members that they define."""
    names = []
    for path, item in public_objects().items():
        names.append(path)
        for owner in inspect.getmro(item) if inspect.isclass(item) else ():
            if owner.__module__.startswith("isa_nrsfm"):
                names += [
                    f"{path}.{name}"
                    for name, member in vars(owner).items()
                    if not name.startswith("_")
                    and (
                        inspect.isfunction(member)
                        or isinstance(member, property | classmethod | staticmethod)
                    )
                ]
    return sorted(set(names))


def run(*command):
    """Return the exit status and the output of a command at the root."""
    done = subprocess.run(
        [sys.executable, *command], cwd=ROOT, capture_output=True, text=True
    )
    return done.returncode, done.stdout + done.stderr


LINTERS = {
    "ruff": ["-m", "ruff", "check", *FOLDERS],
    "format": ["-m", "ruff", "format", "--check", *FOLDERS],
    "mypy": ["-m", "mypy"],
    "imports": ["-c", "from importlinter.cli import lint_imports_command as f; f()"],
}
LINTERS["imports"].append("--no-cache")


@pytest.mark.lint
@pytest.mark.parametrize("linter", LINTERS)
def test_linters_have_no_complaints(linter):
    status, output = run(*LINTERS[linter])
    assert status == 0, output


@pytest.mark.lint
@pytest.mark.parametrize("name", documented_names())
def test_docstrings_are_complete(name):
    errors = [e for e in validate(name)["errors"] if e[0] not in NOT_NEEDED]
    item = public_objects().get(name)
    if hasattr(item, "_fields"):
        # The fields of a named tuple may be documented as attributes.
        sections = inspect.getdoc(item).partition("\nAttributes\n")[2]
        if all(f"\n{field} : " in sections for field in item._fields):
            errors = [e for e in errors if e[0] != "PR01"]
    assert errors == []


def undocumented(tree):
    """Return what has no docstring, or "the module"."""
    if not ast.get_docstring(tree):
        yield "the module"
    inner = set()
    for node in ast.walk(tree):  # breadth first: outer functions come before inner ones
        if isinstance(node, ast.FunctionDef):
            inner |= {id(child) for child in ast.walk(node) if child is not node}
            exempt = (
                node.name in ("__init__", "__call__")
                or node.name == "_unmix"  # documented where it is declared
                or id(node) in inner
                or any(ast.unparse(d) == "overload" for d in node.decorator_list)
            )
        elif isinstance(node, ast.ClassDef):
            exempt = False
        else:
            continue
        if not exempt and not ast.get_docstring(node):
            yield f"{node.lineno} {node.name}"


def state_of(tree):
    """Return names of a module that are neither constants nor types."""
    yield from (node for node in ast.walk(tree) if isinstance(node, ast.Global))
    for node in tree.body:
        for target in node.targets if isinstance(node, ast.Assign) else ():
            for name in ast.walk(target):
                if isinstance(name, ast.Name) and not name.id.startswith("__"):
                    if not name.id.strip("_")[0].isupper():
                        yield name.id


def private_imports(tree):
    """Return private names that are taken of other modules."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith(
            "isa_nrsfm"
        ):
            folder = ROOT / str(node.module).replace(".", "/")
            names = {a.name for a in node.names if a.name.startswith("_")}
            modules = {name for name in names if (folder / f"{name}.py").is_file()}
            yield from names - modules - {"__version__"}


def test_modules_have_docstrings_no_state_and_public_names_of_each_other():
    for file in PACKAGE.rglob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for faults_of in (undocumented, state_of, private_imports):
            assert not [*faults_of(tree)], file


def test_the_top_of_the_package_and_modules_are_short():
    assert len(list(PACKAGE.glob("*.py"))) <= 10
    for file in PACKAGE.rglob("*.py"):
        assert file.read_text(encoding="utf-8").count("\n") <= 1200, file


def test_tests_patch_no_constant_and_import_no_other_test():
    for file in TESTS.glob("*.py"):
        code = file.read_text(encoding="utf-8")
        # Limits are arguments: no constant, a name in capitals, is patched.
        patched = r"(\.setattr|mock\.patch[.\w]*)\([^)]*\b_?[A-Z][A-Z0-9_]+\""
        assert not re.search(patched, code), file
        imported = r"^\s*(from|import) (tests\.)?test_"
        assert not re.search(imported, code, re.MULTILINE), file
