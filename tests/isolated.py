"""A function that a process of its own calls: its module imports nothing else."""


def measured_square(measured, x):
    """Return a square, unless there is none, or one that takes for ever."""
    with measured():
        while x < 0:
            pass
        return {"square": x**2}
