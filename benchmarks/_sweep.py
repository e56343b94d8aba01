"""Settings of which one is varied at a time, and their tables and panels."""

from typing import NamedTuple

from benchmarks._markdown import cell, select, table


class Sweep(NamedTuple):
    """
    Settings of which one is varied at a time.

    Attributes
    ----------
    base : dict
        Each setting where another one is varied.
    varied : dict of tuple
        What each setting is varied over.
    axes : dict of str
        What each setting is called.
    """

    base: dict
    varied: dict
    axes: dict

    def settings(self):
        """Return all settings, each once."""
        listed = [
            self.base | {name: value}
            for name, values in self.varied.items()
            for value in values
        ]
        return list({tuple(setting.items()): setting for setting in listed}.values())

    def along(self, records, name):
        """Return for each value of a setting its records, the others as in `base`."""
        return {
            value: select(records, **(self.base | {name: value}))
            for value in self.varied[name]
        }

    def panels(self, records):
        """Return the panels of `draw_curves`."""
        return [(axis, self.along(records, name)) for name, axis in self.axes.items()]

    def tables(self, records, titles, measure, digits=3):
        """Return a table a setting, with a row a value and a column a method."""
        methods = [name for name in titles if select(records, method=name)]
        headings = [titles[method] for method in methods]
        return [
            table(
                [axis, *headings],
                [
                    [
                        f"{value:g}",
                        *(
                            cell(select(found, method=method), measure, digits)
                            for method in methods
                        ),
                    ]
                    for value, found in settings.items()
                ],
            )
            for axis, settings in self.panels(records)
        ]
