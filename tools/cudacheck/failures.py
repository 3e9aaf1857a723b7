"""What goes wrong in the tool itself, as against what it finds in a program."""

from __future__ import annotations


class CudaCheckError(Exception):
    """The check could not be carried out; the message is one line for the user."""


class MissingToolError(CudaCheckError):
    """A program that the check needs, a compiler or an assembler, is not installed."""


class UnsupportedPtxError(CudaCheckError):
    """PTX that the translator does not know."""
