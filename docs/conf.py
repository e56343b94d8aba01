"""Configuration of the documentation, for ``sphinx-build -W docs <folder>``."""

import os

# Before numpy is imported: the tables of the examples are too small for more threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import importlib
import sys
from pathlib import Path
from pkgutil import iter_modules

from sphinx_gallery.sorting import ExplicitOrder

import isa_nrsfm

sys.path.insert(0, str(Path(__file__).parent))  # for _mathml

project = "isa_nrsfm"
author = "The isa_nrsfm developers"
copyright = author
version = release = isa_nrsfm.__version__

extensions = [
    "_mathml",
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_templates", "examples", "paper"]
templates_path = ["_templates"]

# Everything is found without a network: there is no intersphinx, and names of other
# packages are not links.
nitpicky = True
# What is in single backticks in a docstring is a link where it is public, and otherwise
# the name of a parameter, an attribute or a symbol.
default_role = "py:obj"
nitpick_ignore_regex = [
    ("py:obj", r"[^.]+"),
    ("py:obj", r"AffineNRSfM\.\w+_"),  # attributes stand on the page of the class
    ("py:obj", r".*\.[A-Z_]+"),  # constants have no page
]
MODULES = [m.name for m in iter_modules(isa_nrsfm.__path__) if m.name[0] != "_"]

numpydoc_show_class_members = False
autodoc_typehints = "none"
autosummary_generate = True
autosummary_imported_members = True
autosummary_ignore_module_all = False
autodoc_member_order = "bysource"

myst_heading_anchors = 3
myst_enable_extensions = ["attrs_block", "dollarmath"]

# Formulas need no network, either.
html_math_renderer = "mathml"

html_theme = "pydata_sphinx_theme"
html_title = "isa_nrsfm"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_show_sourcelink = False
html_theme_options = {
    "navbar_align": "left",
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "show_prev_next": False,
    "footer_start": ["copyright"],
    "footer_end": [],
}

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "subsection_order": ExplicitOrder(
        ["examples/guide", "examples/sources", "examples/problems"]
    ),
    "within_subsection_order": ExplicitOrder(
        [
            "plot_method.py",
            "plot_independence.py",
            "plot_cameras.py",
            "plot_webcam.py",
            "plot_consensus.py",
            "plot_choosing_k.py",
            "plot_missing_and_outliers.py",
            "plot_pose_and_units.py",
            "plot_pca_and_fastica.py",
            "plot_openface.py",
            "plot_mediapipe.py",
            "plot_dlib.py",
            "plot_deeplabcut.py",
            "plot_coco.py",
            "plot_expressions.py",
            "plot_labels_and_people.py",
            "plot_motion.py",
            "plot_similar_faces.py",
            "plot_occluded_points.py",
            "plot_shape_model.py",
            "plot_hands.py",
            "plot_real_hands.py",
            "plot_body.py",
        ]
    ),
    "backreferences_dir": "gallery/backreferences",
    "doc_module": ("isa_nrsfm",),
    "reference_url": {"isa_nrsfm": None},
    "download_all_examples": False,
    "write_computation_times": False,
    "show_signature": False,
    "remove_config_comments": True,
    "capture_repr": ("_repr_html_",),
}


def public_names():
    """Return where the public names are documented: their paths by their names."""
    paths = {"AffineNRSfM": "isa_nrsfm.AffineNRSfM"}
    for module in MODULES:
        path = f"isa_nrsfm.{module}"
        for name in importlib.import_module(path).__all__:
            paths.setdefault(name, f"{path}.{name}")
    return paths


def find_public_name(app, env, node, contnode):
    """Resolve a name without its module, such as ``AffineNRSfM.reconstruct``."""
    if node.get("refdomain") != "py":
        return None
    parts = node["reftarget"].split(".")
    known = public_names()
    while parts and parts[0] not in known:
        if parts.pop(0) not in ["isa_nrsfm", *MODULES]:
            return None
    if not parts:
        return None
    path = ".".join([known[parts[0]], *parts[1:]])
    domain = env.domains["py"]
    return domain.resolve_xref(
        env, node["refdoc"], app.builder, "obj", path, node, contnode
    )


def leave_out(app, what, name, obj, skip, options):
    """Leave out methods of scikit-learn and of tuples, and the fields of tuples."""
    module = getattr(obj, "__module__", None) or ""
    of_tuple = getattr(obj, "__objclass__", None) is tuple
    field = type(obj).__name__ == "_tuplegetter"
    return True if module.startswith("sklearn.") or of_tuple or field else None


def setup(app):
    """Connect what is defined here."""
    app.connect("missing-reference", find_public_name)
    app.connect("autodoc-skip-member", leave_out)
