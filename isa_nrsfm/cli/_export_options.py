"""The options of the command export."""

import argparse
from collections.abc import Callable

from isa_nrsfm.cli._drawing_options import add_drawing_options

# What can be written, and the suffixes that tell it.
SUFFIXES = {
    "viewer": (".html", ".htm"),
    "glb": (".glb",),
    "pdm": (".txt",),
    "shapes": (".npz", ".mat"),
}

EXPORT_HELP = (
    """\
Write what a fit has found for other programs. The suffix of the output tells what:
  .html        a page to look at the shapes and frames in 3D, for any browser
  .glb         glTF 2.0: the mean shape with the basis shapes as morph targets
  .txt         a point distribution model as OpenFace and the CLM framework read it
  .npz, .mat   the arrays of the model for NumPy, MATLAB and Octave""",
    """\
examples:
  isa-nrsfm export results/model.npz --output faces.glb
  isa-nrsfm export results/model.npz --output pdm.txt --n-modes 0.98
  isa-nrsfm export results/model.npz --output pdm.mat --content pdm
  isa-nrsfm export results/model.npz faces.csv --label expression --output faces.html

Shapes are upright and frontal, and have the proportions that weak-perspective cameras
tell, except in .npz and .mat, which have the arrays as they are in the model. Models of
'fit --camera weak_perspective' or 'orthographic' have true proportions as they are.""",
)


def add_export_options(
    parser: argparse.ArgumentParser, path: Callable[[str], str]
) -> None:
    """Add the options that say what is written, and how."""
    group = parser.add_argument_group("output")
    group.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        type=path,
        required=True,
        help="the file to write",
    )
    group.add_argument(
        "--content",
        choices=list(SUFFIXES),
        help="what to write where the suffix does not tell: pdm for a point "
        "distribution model as .mat (M, V and E) or .npz",
    )
    group.add_argument(
        "--n-modes",
        metavar="N",
        type=_number_or_share,
        help="modes of the point distribution model: their number, or the share of the "
        "variance that they have, such as 0.98 (default: as many as basis shapes)",
    )
    add_drawing_options(
        group,
        path,
        "in .html and .glb",
        "those of a layout that is known, and in .glb a surface through the points of "
        "faces and of all else that is not known",
    )
    group.add_argument(
        "--names",
        metavar="NAMES",
        type=lambda text: [name.strip() for name in text.split(",")],
        help="for .html and .glb, names of the basis shapes, with commas between them",
    )
    group.add_argument(
        "--label",
        metavar="COLUMN",
        help="for .html, the column of TABLE by which frames have their colours",
    )
    group.add_argument(
        "--n-frames",
        metavar="N",
        type=int,
        help="for .html, the most frames that are shown (default: 1000)",
    )
    group.add_argument(
        "--camera",
        choices=["weak_perspective", "none"],
        help="what is known of the cameras of a model with affine ones; none for "
        "affine shapes, whose angles and depth are not those of the object (default: "
        "weak_perspective)",
    )
    group.add_argument(
        "--mirrored",
        action="store_true",
        default=None,
        help="take the mirror image in depth, which the images do not tell apart",
    )


def _number_or_share(text: str) -> float:
    """Read a whole number of at least 1 or a share between 0 and 1."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if 0 < number < 1:
        return number
    if number < 1 or not number.is_integer():
        raise argparse.ArgumentTypeError(
            f"expected a whole number or a share between 0 and 1; got {text!r}"
        )
    return int(number)
