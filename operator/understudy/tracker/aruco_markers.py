"""Finds ArUco markers in images."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from understudy.tracker.image_messages import Gray

Corners = NDArray[np.float64]
"""The corners of a marker's black square in pixels, 4 x 2: clockwise in the image, beginning with the marker's own
upper left one."""

THRESHOLD_WINDOW = 13
"""Size in pixels of the window of the adaptive threshold. At the usual sizes one window finds markers as surely as
three, for a third of the work."""


class Detector:
    """Detects the markers of one dictionary."""

    def __init__(self, dictionary: str) -> None:
        """``dictionary`` is OpenCV's name of it."""
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
        parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = THRESHOLD_WINDOW
        known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
        self._detector = cv2.aruco.ArucoDetector(known, parameters)

    def find(self, image: Gray) -> dict[int, Corners]:
        """Return the markers in an image by their numbers.

        A number that appears twice is left out, since the two cannot be distinguished.
        """
        corners, numbers, _ = self._detector.detectMarkers(image)
        if numbers is None:
            return {}
        flat = [int(number) for number in np.asarray(numbers).ravel()]
        return {
            number: np.asarray(square, np.float64).reshape(4, 2)
            for number, square in zip(flat, corners, strict=True)
            if flat.count(number) == 1
        }
