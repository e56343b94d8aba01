"""The command demo: fit an artificial table of faces and compare with the truth."""

import shlex
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.cli._drawing import drawing_options
from isa_nrsfm.cli._fit import fit_table
from isa_nrsfm.cli._parser import PROGRAM, build_parser
from isa_nrsfm.cli._sections import fit_text, text_of
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.export._names import names_of_components
from isa_nrsfm.metrics import affine_shape_error, basis_similarity

if TYPE_CHECKING:
    from sklearn.utils import Bunch

_CAMERA: Final = "weak_perspective"


def run(args: Namespace, warned: list[str], tried: str = "1-5") -> str:
    """Fit artificial faces with the numbers of basis shapes to try; report truths."""
    pd = import_optional("pandas", extra="io")
    faces = make_face_tracks(400, n_components=3, camera=_CAMERA, random_state=0)
    table = pd.DataFrame(faces.data.round(2), columns=faces.feature_names)
    table.insert(0, "frame", [f"face{i:03d}" for i in range(len(table))])
    folder = Path(args.output)
    options = [
        *("fit", str(folder / "tracks.csv")),
        *("--n-components", tried),
        *("--camera", _CAMERA),
        *("--output", str(folder)),
        *(["--no-figures"] if args.no_figures else []),
        *drawing_options(args),
    ]
    started = Namespace(arguments=options, since=args.since)
    report = fit_table(
        build_parser().parse_args(options, started),
        warned,
        table=table,
        truth=lambda estimator, X: _compare(faces, estimator, X),
    )
    truth = report["truth"]
    lines = [
        f"the 3D shapes of the frames are off by {100 * truth['shape_error']:.1f} % "
        f"(the mean shape alone: {100 * truth['mean_shape_error']:.1f} %)"
    ]
    width = max(map(len, faces.component_names))
    lines += [
        f"{row['name']:{width}} is {row['found_as']}: similarity of the basis shapes "
        f"{row['similarity']:.2f}, correlation of the coefficients "
        f"{row['correlation']:.2f}"
        for row in truth["basis"]
    ]
    ending = {"Truth": lines, "Again": [shlex.join([PROGRAM, *options])]}
    return f"{fit_text(report, folder)}\n\n{text_of('', ending)}"


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
    names = names_of_components(None, len(estimator.basis_))
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
