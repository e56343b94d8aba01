"""Texts that UTF-8 cannot hold: names of files that are not UTF-8."""


def as_utf8(text: str) -> str:
    r"""
    Return a text that can be written as UTF-8.

    Python marks each byte of a file's name that is not UTF-8 by a lone surrogate, which
    cannot be encoded (PEP 383). It becomes six characters:

    >>> import os
    >>> from isa_nrsfm._compat.texts import as_utf8
    >>> print(as_utf8("café " + os.fsdecode(b"caf\xe9")))
    café caf\udce9
    """
    return text.encode("utf-8", "backslashreplace").decode()
