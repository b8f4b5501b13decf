"""Frame rates computed from the rounded frame times of files, and frame times to write."""

from __future__ import annotations

from marey_motion.errors import FormatError
from marey_motion.importing.checks import CheckWarning
from marey_schemas.documents.clips import MAX_FRAME_RATE_HZ

KNOWN_RATES_HZ = (
    *(10.0, 12.0, 12.5, 15.0, 20.0, 24.0, 25.0, 30.0, 40.0, 48.0, 50.0, 60.0, 72.0, 75.0, 80.0, 90.0, 96.0, 100.0),
    *(120.0, 125.0, 144.0, 150.0, 180.0, 200.0, 240.0, 250.0, 300.0, 360.0, 400.0, 480.0, 500.0, 600.0, 960.0, 1000.0),
    *(24000 / 1001, 30000 / 1001, 60000 / 1001, 120000 / 1001, 240000 / 1001),
)
SNAP_TOLERANCE = 1e-4
# Smaller deviations have no warning, because frame times with six decimals are not more exact.
NOTABLE_DEVIATION = 2e-5
# Greatest relative deviation of a rate that is computed from a frame time with three decimals.
ROUNDED_DEVIATION = 0.02
# A greater "frame time" is a rate, or is in milliseconds: no recording has fewer frames.
LONGEST_FRAME_TIME_S = 1.0


def frame_rate_of(frame_time_s: float | None, file: str, warnings: list[CheckWarning]) -> float:
    """Compute the rate of a file from its frame time.

    Files round frame times: .0083333 means 120 Hz. Therefore, the reciprocal of the frame time is compared with the
    nearest common rate, such as 30 or 120 Hz:

    * If the relative difference is at most 1e-4, the common rate is used, with a warning above 2e-5.
    * If the relative difference is greater, the reciprocal is used. Below 2 %, as for .0333 and 30 Hz, a warning names
      the common rate, because the file may mean this rate.

    Parameters
    ----------
    frame_time_s : float or None    seconds between frames; None if the file does not contain it
    file : str    name of the file, for messages
    warnings : list of CheckWarning    receives the warnings

    Returns
    -------
    float    frames per second

    Raises
    ------
    FormatError    if the frame time gives no valid rate; the error names the option that sets the rate
    """
    if frame_time_s is None:
        raise _no_rate(
            "the file declares no Frame Time",
            file,
        )
    if LONGEST_FRAME_TIME_S < frame_time_s < float("inf"):
        reason = f"a Frame Time of {frame_time_s:g} s is too long; it looks like a frame rate, or like milliseconds"
        raise _no_rate(reason, file)
    if not 1.0 / MAX_FRAME_RATE_HZ <= frame_time_s < float("inf"):
        raise _no_rate(f"a Frame Time of {frame_time_s} s is not a valid time between frames", file)
    declared_hz = 1.0 / frame_time_s
    nearest_hz = min(KNOWN_RATES_HZ, key=lambda rate_hz: abs(rate_hz - declared_hz))
    deviation = abs(nearest_hz - declared_hz) / nearest_hz
    rate_hz = nearest_hz if deviation <= SNAP_TOLERANCE else declared_hz
    if NOTABLE_DEVIATION < deviation <= SNAP_TOLERANCE:
        message = f"a frame time of {frame_time_s} s is read as {nearest_hz:.6g} Hz, not {declared_hz:.6f} Hz"
        values = {"declared_hz": declared_hz, "used_hz": nearest_hz}
        warnings.append(CheckWarning("frame-time-snapped", message, values=values))
    elif SNAP_TOLERANCE < deviation < ROUNDED_DEVIATION:
        message = (
            f"a frame time of {frame_time_s} s is read as {declared_hz:.6g} Hz; "
            f"if {nearest_hz:.6g} Hz are meant, set the rate with --fps (frame_rate_hz)"
        )
        values = {"used_hz": declared_hz, "nearest_hz": nearest_hz}
        warnings.append(CheckWarning("frame-rate-unusual", message, values=values))
    return rate_hz


def frame_time_to_write(frame_rate_hz: float) -> float:
    """Compute the frame time to write in a file, and refuse a rate that readers do not accept.

    Parameters
    ----------
    frame_rate_hz : float    frames per second of the clip

    Returns
    -------
    float    seconds between frames

    Raises
    ------
    FormatError    if the rate is less than 1 Hz or more than 100 kHz
    """
    lowest_hz = 1.0 / LONGEST_FRAME_TIME_S
    if not lowest_hz <= frame_rate_hz <= MAX_FRAME_RATE_HZ:
        raise FormatError(
            f"a clip of {frame_rate_hz:.6g} Hz cannot be written in this format, whose frame rates must be "
            f"from {lowest_hz:g} to {MAX_FRAME_RATE_HZ:.0f} Hz; resample the clip, or write it as npz",
            code="frame-rate",
        )
    return 1.0 / frame_rate_hz


def _no_rate(reason: str, file: str) -> FormatError:
    return FormatError(f"{reason}; set the rate with --fps (frame_rate_hz)", code="frame-time", file=file)
