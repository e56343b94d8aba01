"""Settings that need others, in messages of the command line."""

from fit_runs import told
from refusals import refusals_of


def fit(options):
    """Raise the message of a fit with options that exclude each other."""
    told("fit", "absent.csv", "-o", "absent", *options.split())


test_refusals = refusals_of("requirements", globals())
