"""How things end: the status of a fit, and the exceptions.

::

    PhytofitError                 anything phytofit raises on purpose
    ├── InputError                what was given can't be used; the message says what to give instead
    │   ├── CloudError            a cloud: unreadable, empty, too few points, wrong shape
    │   ├── UnitError             a unit: missing, unknown, or one in which the cloud has no plausible size
    │   ├── SpeciesError          a species file: unknown or missing keys, impossible values
    │   └── SettingError          a setting: negative, not finite, out of its range
    ├── NoPhytomerError           the cloud was read, but holds no stem with a leaf
    ├── NoStemError               the cloud was read, but it can't be parted into a stem and leaves
    └── OutputError               results can't be written where they were asked for

Inside the fitting loop a failure is a value, :class:`Status`; at the edge of the package (reading, writing,
settings) it is one of these exceptions.  Every message names the thing, what it was, what it should be and what
to do.
"""

from enum import Enum

__all__ = [
    "ONE_LEAF_ONLY",
    "CloudError",
    "InputError",
    "NoPhytomerError",
    "NoStemError",
    "OutputError",
    "PhytofitError",
    "SettingError",
    "SpeciesError",
    "Status",
    "UnitError",
]


ONE_LEAF_ONLY = "measure a whole plant with phytofit.run, or give a seed point on the leaf you want"


class Status(Enum):
    """How a fit ended; the value is the sentence that is shown and stored."""

    CONVERGED = "converged: the mean of the last elite is as good as its members"
    SPLIT_ELITE = (
        "did not converge: the best candidates of the last generation differ. Use more generations or samples, or "
        "another seed"
    )
    AT_REST = "converged: no small change makes the fit more probable"
    MOVING = "did not converge: the refinement stopped before it came to rest. Look at fit.png, or try another seed"

    @property
    def good(self) -> bool:
        """Whether the fit converged."""
        return self in (Status.CONVERGED, Status.AT_REST)


class PhytofitError(Exception):
    """Base of everything that phytofit raises on purpose."""


class InputError(PhytofitError, ValueError):
    """What was given can't be used."""


class CloudError(InputError):
    """A cloud is unreadable, empty, too small or of the wrong shape."""


class UnitError(InputError):
    """A unit is missing, unknown, or makes the cloud implausibly small or large."""


class SpeciesError(InputError):
    """A species file has unknown or missing keys, or impossible values."""


class SettingError(InputError):
    """A setting is negative, not finite or out of its range."""


class NoPhytomerError(PhytofitError, ValueError):
    """The cloud was read, but no stem with a leaf on it can be found."""


class NoStemError(PhytofitError, ValueError):
    """A plant's cloud was read, but no stem from which leaves part can be found in it."""


class OutputError(PhytofitError, OSError):
    """Results can't be written where they were asked for."""
