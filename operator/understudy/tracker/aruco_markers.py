"""Finds ArUco markers in images."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from understudy.tracker.image_messages import Gray

Corners = NDArray[np.float64]
"""The corners of a marker's black square in pixels, 4 x 2: from its own upper left on, clockwise as seen."""

THRESHOLD_WINDOW = 13
"""Pixels over which it is looked what is dark: one window is found as surely as three at the usual sizes, for a third of the work."""


class Detector:
    """Of one set of markers."""

    def __init__(self, dictionary: str) -> None:
        """``dictionary`` by OpenCV's name."""
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
        parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = THRESHOLD_WINDOW
        known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
        self._detector = cv2.aruco.ArucoDetector(known, parameters)

    def find(self, image: Gray) -> dict[int, Corners]:
        """The markers in an image by their numbers. One that is there twice cannot be distinguished, and is not found."""
        corners, numbers, _ = self._detector.detectMarkers(image)
        if numbers is None:
            return {}
        flat = [int(number) for number in np.asarray(numbers).ravel()]
        return {
            number: np.asarray(square, np.float64).reshape(4, 2)
            for number, square in zip(flat, corners, strict=True)
            if flat.count(number) == 1
        }
