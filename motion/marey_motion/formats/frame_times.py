"""Frame rates behind rounded frame times."""

from __future__ import annotations

from marey_motion.checks import CheckWarning
from marey_motion.errors import FormatError

KNOWN_RATES_HZ = (
    *(10.0, 12.0, 12.5, 15.0, 20.0, 24.0, 25.0, 30.0, 40.0, 48.0, 50.0, 60.0, 72.0, 75.0, 80.0, 90.0, 96.0, 100.0),
    *(120.0, 125.0, 144.0, 150.0, 180.0, 200.0, 240.0, 250.0, 300.0, 360.0, 400.0, 480.0, 500.0, 600.0, 960.0, 1000.0),
    *(24000 / 1001, 30000 / 1001, 60000 / 1001, 120000 / 1001, 240000 / 1001),
)
SNAP_TOLERANCE = 1e-4
# What six decimals of a frame time leave open needs no mention.
NOTABLE_DEVIATION = 2e-5
HIGHEST_RATE_HZ = 100_000.0


def frame_rate_of(frame_time_s: float, file: str, warnings: list[CheckWarning]) -> float:
    """The rate of a file whose frames are `frame_time_s` apart.

    Files round: .0083333 means 120 Hz. A known rate within a relative 1e-4 is taken instead of the reciprocal, and
    where they differ beyond the last bits a warning says so.
    """
    if not 1.0 / HIGHEST_RATE_HZ <= frame_time_s < float("inf"):
        raise FormatError(
            f"a Frame Time of {frame_time_s} s gives no frame rate; set it with --fps (frame_rate_hz)",
            code="frame-time",
            file=file,
        )
    declared_hz = 1.0 / frame_time_s
    nearest_hz = min(KNOWN_RATES_HZ, key=lambda rate_hz: abs(rate_hz - declared_hz))
    deviation = abs(nearest_hz - declared_hz) / nearest_hz
    if deviation > SNAP_TOLERANCE:
        return declared_hz
    if deviation > NOTABLE_DEVIATION:
        warnings.append(
            CheckWarning(
                "frame-time-snapped",
                f"a frame time of {frame_time_s} s is read as {nearest_hz:.6g} Hz, not {declared_hz:.6f} Hz",
                values={"declared_hz": declared_hz, "used_hz": nearest_hz},
            )
        )
    return nearest_hz
