"""Writes a film frame by frame: ``.gif`` through Pillow, anything else through ffmpeg."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import BackendError


def _find_ffmpeg() -> str | None:
    """The machine's own ffmpeg, else the one that comes as a Python package."""
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        try:
            import imageio_ffmpeg
        except ImportError:
            return None
        ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    return ffmpeg


def frame_period(path: str) -> float:
    """Time between the frames of a film, s: 30 a second; 25 in a GIF, which counts in 10 ms."""
    return 0.04 if Path(path).suffix.lower() == ".gif" else 1.0 / 30.0


class VideoWriter:
    """Film at ``path`` with one frame per ``dt`` s; ``shape`` is (height, width) in pixels.

    Raises
    ------
    BackendError
        if the film is not a GIF and there is no ffmpeg.
    """

    def __init__(self, path: str, dt: float, shape: tuple[int, int]) -> None:
        self._path = path
        self._dt = dt
        self._shape = tuple(shape)
        self._images: list[Any] | None = [] if Path(path).suffix.lower() == ".gif" else None
        self._process: subprocess.Popen[bytes] | None = None
        if self._images is None:
            ffmpeg = _find_ffmpeg()
            if ffmpeg is None:
                raise BackendError(
                    f"--video {path}: needs the program 'ffmpeg'; install it or the package "
                    "imageio-ffmpeg (pip install 'crazyarena[video]'), or choose a file ending "
                    "in .gif"
                )
            height, width = self._shape
            self._process = subprocess.Popen(
                [ffmpeg, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24",
                 "-s", f"{width}x{height}", "-r", f"{1.0 / dt}", "-i", "-",
                 "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-crf", "18",
                 # What players, phones and browsers can play; lossless RGB is not.
                 "-pix_fmt", "yuv420p", "-movflags", "+faststart", path],
                stdin=subprocess.PIPE,
            )  # fmt: skip

    def writeFrame(self, frame: NDArray[np.uint8]) -> None:
        """Append one RGB frame (height, width, 3); ValueError if its size differs."""
        if frame.shape[:2] != self._shape:
            raise ValueError(f"frame is {frame.shape[:2]}; the film is {self._shape}")
        pixels = np.ascontiguousarray(frame[..., :3], dtype=np.uint8)
        if self._images is not None:
            from PIL import Image

            self._images.append(Image.fromarray(pixels))
        elif self._process is not None and self._process.stdin is not None:
            self._process.stdin.write(pixels.tobytes())

    def close(self) -> None:
        """Finish the file; idempotent."""
        if self._images:
            first, *rest = self._images
            first.save(
                self._path,
                save_all=True,
                append_images=rest,
                duration=max(1, round(1e3 * self._dt)),
            )
            self._images = []
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
            self._process.wait()
            self._process = None
