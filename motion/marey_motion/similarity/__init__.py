"""Search by example: moments of many clips that resemble a pose or a window of frames."""
