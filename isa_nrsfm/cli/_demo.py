"""The command demo: an artificial table of faces, and how near the truth its fit is."""

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.cli._commands import fit_table
from isa_nrsfm.cli._drawing_options import drawing_options
from isa_nrsfm.cli._outputs import component_names
from isa_nrsfm.cli._parser import PROGRAM, build_parser
from isa_nrsfm.cli._report import fit_text, lay_out
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.metrics import affine_shape_error, basis_similarity

if TYPE_CHECKING:
    from sklearn.utils import Bunch

_N_FRAMES = 400
_N_COMPONENTS = 3
_TRIED = "1-5"
# The cameras by which the faces are made.
_CAMERA: Final = "weak_perspective"
_SEED = 0


def run_demo(args: Namespace, warned: list[str], tried: str = _TRIED) -> str:
    """
    Fit a table of artificial faces, and return the report with the truth.

    The numbers of basis shapes that are tried are as of ``--n-components``.
    """
    pd = import_optional("pandas", extra="io")
    faces = make_face_tracks(
        _N_FRAMES, n_components=_N_COMPONENTS, camera=_CAMERA, random_state=_SEED
    )
    table = pd.DataFrame(faces.data.round(2), columns=faces.feature_names)
    table.insert(0, "frame", [f"face{i:03d}" for i in range(_N_FRAMES)])
    folder = Path(args.output)
    options = [
        *("fit", str(folder / "tracks.csv")),
        *("--n-components", tried),
        *("--camera", _CAMERA),
        *("--output", str(folder)),
        *(["--no-figures"] if args.no_figures else []),
        *drawing_options(args),
    ]
    report = fit_table(
        build_parser().parse_args(
            options, Namespace(arguments=options, since=args.since)
        ),
        warned,
        table=table,
        truth=lambda estimator, X: _compare(faces, estimator, X),
    )
    truth = report["truth"]
    lines = [
        f"the 3D shapes of the frames are off by {_percent(truth['shape_error'])} "
        f"(the mean shape alone: {_percent(truth['mean_shape_error'])})"
    ]
    width = max(map(len, faces.component_names))
    lines += [
        f"{row['name']:{width}} is {row['found_as']}: similarity of the basis shapes "
        f"{row['similarity']:.2f}, correlation of the coefficients "
        f"{row['correlation']:.2f}"
        for row in truth["basis"]
    ]
    command = " ".join(f"'{word}'" if " " in word else word for word in options)
    ending = {"Truth": lines, "Again": [f"{PROGRAM} {command}"]}
    return f"{fit_text(report, folder)}\n\n{lay_out(ending)}"


def _compare(faces: "Bunch", estimator: AffineNRSfM, X: Any) -> dict[str, Any]:
    """Compare a fitted model with the truth."""
    shapes = estimator.reconstruct(X)
    rigid = np.broadcast_to(estimator.mean_shape_, shapes.shape)
    similarity, matching = basis_similarity(
        faces.basis,
        estimator.basis_,
        mean_shape_true=faces.mean_shape,
        mean_shape=estimator.mean_shape_,
        modulo_mean_shape=True,
        return_matching=True,
    )
    correlation = np.corrcoef(faces.alpha.T, estimator.alpha_.T)
    names = component_names(len(estimator.basis_))
    return {
        "shape_error": affine_shape_error(faces.shapes, shapes),
        "mean_shape_error": affine_shape_error(faces.shapes, rigid),
        "basis": [
            {
                "name": name,
                "found_as": names[found],
                "similarity": similarity[k],
                "correlation": abs(correlation[k, len(faces.basis) + found]),
            }
            for k, (name, found) in enumerate(
                zip(faces.component_names, matching, strict=True)
            )
        ],
    }


def _percent(fraction: float) -> str:
    """Write a fraction in percent."""
    return f"{100 * fraction:.1f} %"
