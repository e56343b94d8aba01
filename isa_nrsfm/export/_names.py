"""Names of a model's points and coefficients."""

from typing import Any

from isa_nrsfm._tables.landmark_columns import point_names


def names_of_points(model: Any) -> tuple[str, ...]:
    """Return the names of a model's points, or their numbers."""
    n_points = len(model.mean_shape_)
    columns = getattr(model, "feature_names_in_", None)
    if columns is None:
        return tuple(map(str, range(n_points)))
    names = [str(name).strip() for name in columns]
    x_columns = names[:n_points] if model.layout == "planar" else names[::2]
    return point_names(x_columns)


def names_of_components(names: Any, n_components: int) -> list[str]:
    """Return the names of the coefficients, by default alpha_1, alpha_2, ...

    Numbers count from 1: number 0 is the mean shape.
    """
    if names is None:
        return [f"alpha_{k + 1}" for k in range(n_components)]
    names = [str(name) for name in names]
    if len(names) != n_components:
        raise ValueError(
            f"names must hold {n_components} names, one a basis shape; got {len(names)}"
        )
    return names
