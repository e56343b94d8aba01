"""Conventions of the code: style, types, docstrings, public names, imports."""

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from types import FunctionType

import pytest
from numpydoc.validate import validate
from project import ROOT

import isa_nrsfm

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
MEMBERS = FunctionType | property | classmethod | staticmethod


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
    names = set()
    for path, item in public_objects().items():
        names.add(path)
        for owner in inspect.getmro(item) if inspect.isclass(item) else ():
            if owner.__module__.startswith("isa_nrsfm"):
                for name, member in vars(owner).items():
                    if isinstance(member, MEMBERS) and not name.startswith("_"):
                        names.add(f"{path}.{name}")
    return sorted(names)


LINTERS = {
    "ruff": ["-m", "ruff", "check", *FOLDERS],
    "format": ["-m", "ruff", "format", "--check", *FOLDERS],
    "mypy": ["-m", "mypy"],
    "imports": [
        *("-c", "from importlinter.cli import lint_imports_command as f; f()"),
        "--no-cache",
    ],
}


@pytest.mark.lint
@pytest.mark.parametrize("linter", LINTERS)
def test_linters_have_no_complaints(linter):
    command = [sys.executable, *LINTERS[linter]]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.lint
def test_docstrings_are_complete():
    objects, errors = public_objects(), []
    for name in documented_names():
        not_needed = {*NOT_NEEDED}
        fields = getattr(objects.get(name), "_fields", None)
        if fields is not None:
            # The fields of a named tuple may be documented as attributes.
            doc = inspect.getdoc(objects[name]).partition("\nAttributes\n")[2]
            if all(f"\n{field} : " in doc for field in fields):
                not_needed.add("PR01")
        found = validate(name)["errors"]
        errors += [(name, *each) for each in found if each[0] not in not_needed]
    assert errors == []


def undocumented(node):
    """Return what has no docstring, or "the module"; inner functions need none."""
    is_function = isinstance(node, ast.FunctionDef)
    if is_function or isinstance(node, ast.Module | ast.ClassDef):
        name = getattr(node, "name", "the module")
        # `_unmix` is documented where it is declared.
        exempt = is_function and (
            name in ("__init__", "__call__", "_unmix")
            or any(ast.unparse(d) == "overload" for d in node.decorator_list)
        )
        if not exempt and not ast.get_docstring(node):
            yield name
    if not is_function:
        for child in ast.iter_child_nodes(node):
            yield from undocumented(child)


def state_of(tree):
    """Return names of a module that are neither constants nor types."""
    yield from (node for node in ast.walk(tree) if isinstance(node, ast.Global))
    for node in tree.body:
        for target in node.targets if isinstance(node, ast.Assign) else ():
            names = (n.id for n in ast.walk(target) if isinstance(n, ast.Name))
            yield from (name for name in names if re.match("_?[^A-Z_]", name))


def private_imports(tree):
    """Return private names that are taken of other modules."""
    for node in ast.walk(tree):
        source = str(getattr(node, "module", None))
        if isinstance(node, ast.ImportFrom) and source.startswith("isa_nrsfm"):
            folder = ROOT / source.replace(".", "/")
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
