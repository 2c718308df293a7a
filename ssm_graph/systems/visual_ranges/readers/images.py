"""Images of files, videos and bags as grey frames of one size, and what was wrong with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ssm_graph.base.errors import DataError
from ssm_graph.systems.visual_ranges.extras import opencv
from ssm_graph.systems.visual_ranges.sequence import Image

ENDINGS: Final = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")
VIDEO_ENDINGS: Final = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
DARK_LEVEL: Final = 8.0
"""Grey levels of 255, mean of a black frame."""
BRIGHT_LEVEL: Final = 247.0
"""Grey levels of 255, mean of a white frame."""
FLAT_SHARPNESS: Final = 4.0
"""Grey levels squared, variance of the Laplacian: below it a frame has nothing to hold on to."""
BLUR_RATIO: Final = 0.2
"""A frame is called blurred where its sharpness is below this share of the run's median."""
_SHOWN: Final = 3


def depth_bits(pixels: NDArray[Any]) -> int:
    """Return how many bits the pixels use: 10- and 12-bit sensors are stored in 16."""
    if pixels.dtype != np.uint16 or not pixels.size:
        return 8
    top = int(pixels.max()).bit_length()
    return next(bits for bits in (8, 10, 12, 14, 16) if top <= bits)


def to_grey(pixels: NDArray[Any], *, bits: int = 16, bayer: str = "") -> Image:
    """Return pixels of any usual kind as grey (H, W) uint8.

    Parameters
    ----------
    pixels : (H, W), (H, W, 3) blue-green-red or (H, W, 4), of 8 or 16 bits.
    bits : how many of 16 are used, see :func:`depth_bits`.
    bayer : pattern of a raw sensor, ``rggb``, ``bggr``, ``gbrg`` or ``grbg``; "" for none.
    """
    cv2 = opencv()
    if pixels.dtype == np.uint16:
        pixels = np.minimum(pixels >> (bits - 8), 255).astype(np.uint8)
    elif pixels.dtype != np.uint8:
        raise DataError(f"image: expected pixels of 8 or 16 bits, got {pixels.dtype}")
    if bayer:
        codes = {"rggb": "BayerBG", "bggr": "BayerRG", "gbrg": "BayerGR", "grbg": "BayerGB"}
        if bayer not in codes:
            raise DataError(f"image: expected a pattern of {', '.join(codes)}, got {bayer!r}")
        return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{codes[bayer]}2GRAY")))
    if pixels.ndim == 3 and pixels.shape[2] in (3, 4):
        code = cv2.COLOR_BGR2GRAY if pixels.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        return np.asarray(cv2.cvtColor(pixels, code))
    return np.ascontiguousarray(pixels.reshape(pixels.shape[:2]))


@dataclass(slots=True, eq=False)
class WatchedImages:
    """Images of one size with a count of their defects; a frame that cannot be had comes black.

    Looking at a frame costs a few hundred microseconds; each frame is looked at once.
    """

    load: Callable[[int], NDArray[Any] | None]
    """Pixels of an index in any usual kind, None where they cannot be decoded."""
    width: int
    height: int
    label: Callable[[int], str] = str
    """What messages call a frame."""
    bayer: str = ""
    _sharpness: dict[int, float] = field(default_factory=dict)
    _found: dict[str, list[str]] = field(default_factory=dict)
    _last: tuple[int, int] = (-1, 0)
    _bits: int = 8

    def __call__(self, index: int) -> Image:
        """Return the grey frame (height, width) of an index."""
        pixels = self.load(index)
        is_new = index not in self._sharpness
        if pixels is None:
            self._note(index, "could not be decoded", is_new=is_new)
            self._sharpness.setdefault(index, np.nan)
            return np.zeros((self.height, self.width), dtype=np.uint8)
        self._bits = max(self._bits, depth_bits(pixels))
        grey = to_grey(pixels, bits=self._bits, bayer=self.bayer)
        if grey.shape != (self.height, self.width):
            size = f"{grey.shape[1]} x {grey.shape[0]}"
            if not self._sharpness:
                raise DataError(
                    f"{self.label(index)}: expected images of {self.width} x {self.height} pixels "
                    f"as the calibration says, got {size}; scale the calibration with the images"
                )
            self._note(index, f"had another size ({size})", is_new=is_new)
            self._sharpness.setdefault(index, np.nan)
            return np.zeros((self.height, self.width), dtype=np.uint8)
        if is_new:
            self._look(index, grey)
        return grey

    def defects(self) -> tuple[str, ...]:
        """Return what was found so far, one sentence each."""
        lines = [_told(what, names) for what, names in self._found.items()]
        values = {k: v for k, v in self._sharpness.items() if np.isfinite(v)}
        if values:
            limit = BLUR_RATIO * float(np.median(list(values.values())))
            blurred = [self.label(k) for k, v in values.items() if FLAT_SHARPNESS <= v < limit]
            if blurred:
                lines.append(_told(f"are blurred (sharpness below {limit:.0f})", blurred))
        return tuple(lines)

    def sharpness(self) -> dict[int, float]:
        """Return the variance of the Laplacian of each frame read, NaN where there was none."""
        return dict(self._sharpness)

    def _note(self, index: int, what: str, *, is_new: bool = True) -> None:
        if is_new:
            self._found.setdefault(what, []).append(self.label(index))

    def _look(self, index: int, grey: Image) -> None:
        cv2 = opencv()
        small = np.ascontiguousarray(grey[::2, ::2])
        level = float(small.mean())
        sharpness = float(cv2.Laplacian(small, cv2.CV_16S, ksize=1).var())
        self._sharpness[index] = sharpness
        if level < DARK_LEVEL:
            self._note(index, "are black")
        elif level > BRIGHT_LEVEL:
            self._note(index, "are white")
        elif sharpness < FLAT_SHARPNESS:
            self._note(index, "show nothing that could be tracked")
        key = hash(small.tobytes())
        if self._last == (index - 1, key):
            self._note(index, "repeat the one before (frozen camera?)")
        self._last = (index, key)


def _told(what: str, names: list[str]) -> str:
    first = ", ".join(names[:_SHOWN]) + (" ..." if len(names) > _SHOWN else "")
    return f"images: {len(names)} {what}: {first}"


def image_files(
    paths: Sequence[Path], *, size: tuple[int, int] | None = None, bayer: str = ""
) -> WatchedImages:
    """Return the images of files in the order given; ``size`` (width, height) if it is known."""
    cv2 = opencv()

    def load(index: int) -> NDArray[Any] | None:
        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
        try:
            found = cv2.imread(str(paths[index]), flags)
        except cv2.error:
            return None
        return None if found is None else np.asarray(found)

    width, height = size or first_size(load, len(paths), str(paths[0].parent))
    return WatchedImages(load, width, height, lambda k: paths[k].name, bayer)


def first_size(
    load: Callable[[int], NDArray[Any] | None], n_images: int, where: str
) -> tuple[int, int]:
    """Return width and height of the first image of ten that can be decoded."""
    for index in range(min(n_images, 10)):
        pixels = load(index)
        if pixels is not None:
            return pixels.shape[1], pixels.shape[0]
    raise DataError(f"{where}: none of the first images could be decoded; are they images?")


class VideoFrames:
    """The frames of a video, decoded in order; going back decodes from the beginning again."""

    def __init__(self, path: Path) -> None:
        self._cv2, self._path = opencv(), path
        self._open()
        self.rate_hz = float(self._video.get(self._cv2.CAP_PROP_FPS))
        self.size = (
            int(self._video.get(self._cv2.CAP_PROP_FRAME_WIDTH)),
            int(self._video.get(self._cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        self.n_frames = int(self._video.get(self._cv2.CAP_PROP_FRAME_COUNT))
        if self.n_frames <= 0:
            self.n_frames = self._counted()
        if self.n_frames < 2:
            raise DataError(f"{path}: expected a video of at least 2 frames, got {self.n_frames}")

    def __call__(self, index: int) -> NDArray[Any] | None:
        """Return the frame of an index, None where the video ends before."""
        if index < self._next:
            self._open()
        while self._next < index:
            self._next += 1
            if not self._video.grab():
                return None
        self._next += 1
        is_good, frame = self._video.read()
        return np.asarray(frame) if is_good else None

    def _open(self) -> None:
        self._video = self._cv2.VideoCapture(str(self._path))
        self._next = 0
        if not self._video.isOpened():
            raise DataError(
                f"{self._path}: expected a video that OpenCV can decode; convert it to .mp4 "
                "(H.264) or to a folder of images"
            )

    def _counted(self) -> int:
        count = 0
        while self._video.grab():
            count += 1
        self._open()
        return count
