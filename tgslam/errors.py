"""Every error that tgslam raises on purpose. The CLI prints its message on one line and exits with `exit_code`."""


class TgslamError(Exception):
    """Base of all: the message says what is wrong, where (file, key or frame) and the way out."""

    exit_code = 1


class ConfigError(TgslamError):
    """A config file, key or value that cannot be used."""

    exit_code = 2


class DatasetError(TgslamError):
    """An input folder that cannot be read at all."""


class FrameError(TgslamError):
    """One frame that cannot be used (truncated image, wrong size, no depth); the run skips and counts it."""


class DeviceError(TgslamError):
    """A compute device that was asked for and is not there."""


class ClusterError(TgslamError):
    """A Dask cluster that was asked for and cannot be used."""


class TrackingError(TgslamError):
    """Tracking cannot start or cannot go on."""


class GraphError(TgslamError):
    """A pose graph that has no solution: something in it is not held by any measurement."""


class OutputError(TgslamError):
    """A run folder that cannot be written, or read back."""


class EvaluationError(TgslamError):
    """A metric that cannot be computed from what is there."""
