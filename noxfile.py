"""Checks in fresh environments: ``nox -l`` lists them, ``nox -s lint`` runs one."""

import os
import re
from pathlib import Path

import nox

nox.needs_version = ">=2025.2.9"
nox.options.sessions = ["lint", "quick"]
nox.options.default_venv_backend = "uv|virtualenv"
nox.options.reuse_existing_virtualenvs = True

# The tables of the tests are too small for more threads.
THREADS = {"OPENBLAS_NUM_THREADS": "1"}
# What a page would load from elsewhere when it is viewed.
LOADED = re.compile(
    r"<(?:script|img|iframe|source)\b[^>]*\bsrc=[\"']?(?:https?:)?//"
    r"|<link\b(?=[^>]*\brel=[\"']?(?:stylesheet|preload))[^>]*\bhref=[\"']?"
    r"(?:https?:)?//",
    re.IGNORECASE,
)


@nox.session
def lint(session: nox.Session) -> None:
    """Check style, types, imports, docstrings and the code in the pages."""
    session.install("-e", ".[test]")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    pages = ["tests/test_contributing.py", "tests/test_docs.py"]
    session.run("pytest", "-m", "", "tests/test_conventions.py", *pages, env=THREADS)


@nox.session
def quick(session: nox.Session) -> None:
    """Run the quick layer of the tests."""
    session.install("-e", ".[test]")
    session.run("pytest", "-n", "2", *session.posargs, env=THREADS)


@nox.session
def full(session: nox.Session) -> None:
    """Run all tests."""
    session.install("-e", ".[test]")
    session.run("pytest", "-n", "2", "-m", "", *session.posargs, env=THREADS)


@nox.session(venv_backend="uv")
def lowest(session: nox.Session) -> None:
    """Run the quick layer with the lowest versions that pyproject.toml allows."""
    session.install("--resolution", "lowest-direct", "-e", ".[test]")
    # Old packages call what newer ones, which they bring in, have deprecated.
    options = ["-n", "2", "-W", "default::DeprecationWarning"]
    session.run("pytest", *options, *session.posargs, env=THREADS)


@nox.session
def docs(session: nox.Session) -> None:
    """Build the documentation, and check that its pages need no network."""
    session.install("-e", ".[docs]")
    pages = Path("out", "html")
    options = ["-q", "-W", "--keep-going", "-b", "html", *session.posargs]
    session.run("sphinx-build", *options, "docs", str(pages), env=THREADS)
    found = [
        f"{page}: {match[0]}"
        for page in sorted(pages.rglob("*.html"))
        for match in LOADED.finditer(page.read_text(encoding="utf-8"))
    ]
    if found:
        session.error("pages load from elsewhere:\n" + "\n".join(found))


@nox.session
def benchmarks(session: nox.Session) -> None:
    """Measure all methods; arguments are those of ``python -m benchmarks``."""
    session.install("-e", ".[benchmarks]")
    if "ISA_NRSFM_DATA" not in os.environ:
        session.warn("without ISA_NRSFM_DATA there are generated tables only")
    session.run("python", "-m", "benchmarks", *session.posargs)


@nox.session
def mutation(session: nox.Session) -> None:
    """Change the core in random places, and list changes that no test notices."""
    session.install("-e", ".[mutation]")
    session.run("python", "-m", "benchmarks.mutation", *session.posargs, env=THREADS)
