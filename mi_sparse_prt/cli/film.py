"""Pictures that follow each other, as files of a folder or as a film, of which an interruption loses none."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.cli.files import image_bytes, srgb_pixels
from mi_sparse_prt.cli.running import Command, check_folder
from mi_sparse_prt.core.errors import PrtError

ENCODERS = 2  # threads; pictures that wait for them are as many
DIGITS = 4  # of the names of pictures, at least
QUALITY = 16  # constant rate factor of H.264: no difference is seen below about 18
# as ITU-T H.273 numbers them: without them, players guess by the size of the picture
BT709, SRGB_CURVE, STUDIO_RANGE = 1, 13, 1


class Frames(Protocol):
    """Where frames go."""

    def add(self, image: NDArray[np.float32]) -> None:
        """The next one, linear RGB (height, width, 3)."""

    def finish(self) -> int:
        """Nothing more comes; the size of all in bytes."""


class FrameFolder:
    """Frames as 0000.png, 0001.png, ... in a folder; each appears whole or not at all.

    They are encoded by other threads, while the next ones are made.

    Parameters
    ----------
    command : Command
    folder : Path
        Made if it is not there.
    frames : int
        How many there will be.
    exposure : float
        In stops, of .png files.
    suffix : {".png", ".exr"}
        .exr files have half floats.
    """

    def __init__(
        self, command: Command, folder: Path, frames: int, exposure: float, suffix: str = ".png"
    ) -> None:
        self._command, self._folder, self._exposure, self._suffix = command, folder, exposure, suffix
        folder.mkdir(parents=True, exist_ok=True)
        self._names, self._size = iter(_names(frames, suffix)), 0
        self._encoders, self._encoded = ThreadPoolExecutor(ENCODERS), deque[Future[bytes]]()

    def add(self, image: NDArray[np.float32]) -> None:
        self._encoded.append(
            self._encoders.submit(image_bytes, image, self._suffix, self._exposure, half=True)
        )
        if len(self._encoded) > ENCODERS:
            self._write()

    def finish(self) -> int:
        while self._encoded:
            self._write()
        self._encoders.shutdown()
        return self._size

    def _write(self) -> None:
        content = self._encoded.popleft().result()
        self._size += len(content)
        self._command.write(self._folder / next(self._names), content, part_of=self._folder)


class FilmFile:
    """Frames as an H.264 film; it is kept in memory, and written when it is finished.

    Parameters
    ----------
    command : Command
    path : Path
    fps : float
        Frames per second.
    exposure : float
        In stops.
    """

    def __init__(self, command: Command, path: Path, fps: float, exposure: float) -> None:
        import av

        self._command, self._path, self._exposure = command, path, exposure
        self._rate = Fraction(fps).limit_denominator(1001)  # a float has one of 2^52
        self._content = io.BytesIO()
        self._container = av.open(self._content, "w", format="mp4")
        self._stream: Any = None

    def add(self, image: NDArray[np.float32]) -> None:
        import av

        height, width = image.shape[:2]
        # colours of 2 x 2 pixels are stored together
        image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        if self._stream is None:
            self._stream = self._new_stream(*image.shape[:2])
        frame = av.VideoFrame.from_ndarray(srgb_pixels(image, self._exposure), "rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        self._container.mux(self._stream.encode(frame))

    def finish(self) -> int:
        if self._stream is None:  # no frame was done
            return 0
        self._container.mux(self._stream.encode(None))
        self._container.close()
        self._command.write(self._path, self._content.getvalue())
        return self._content.getbuffer().nbytes

    def _new_stream(self, height: int, width: int) -> Any:
        stream: Any = self._container.add_stream("libx264", self._rate, {"crf": str(QUALITY)})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        codec = stream.codec_context
        codec.colorspace = codec.color_primaries = BT709
        codec.color_trc, codec.color_range = SRGB_CURVE, STUDIO_RANGE
        return stream


def check_frame_folder(folder: Path, frames: int, suffix: str = ".png") -> None:
    """Find out before the work whether frames can be written into a folder, which may still have to be made.

    Raises
    ------
    PrtError
        If they cannot, or if the folder holds frames of a longer film, which would follow these.
    """
    check_folder(folder)
    there = {path.name for path in folder.glob(f"*{suffix}") if path.stem.isdecimal()}
    others = there - {*_names(frames, suffix)}
    if others:
        raise PrtError(
            f"{folder} has frames of a longer film, such as {min(others)}: remove them or choose another folder"
        )


def _names(frames: int, suffix: str) -> list[str]:
    digits = max(DIGITS, len(str(frames - 1)))
    return [f"{frame:0{digits}}{suffix}" for frame in range(frames)]


def new_frames(
    command: Command, output: Path, frames: int, fps: float, exposure: float, folder: bool
) -> Frames:
    """A folder of pictures, or a film file, for so many frames."""
    if folder:
        return FrameFolder(command, output, frames, exposure)
    return FilmFile(command, output, fps, exposure)


def make_film(
    command: Command, into: Frames, images: Iterable[NDArray[np.float32]], frames: int, progress: bool
) -> int:
    """Write images (height, width, 3), linear RGB, one after the other.

    Parameters
    ----------
    command : Command
    into : Frames
        Where they go.
    images : iterable
        All of one size.
    frames : int
        How many images there are.
    progress : bool
        Show a progress bar.

    Returns
    -------
    int
        Bytes of all that was written.

    Raises
    ------
    PrtError
        If it cannot be written.
    KeyboardInterrupt
        After Ctrl-C, when the frame that was begun and all before it are written.
    """
    with command.patient_interrupts() as let_interrupt:
        try:
            bar = tqdm(images, "film", frames, unit=" frames", disable=not progress)
            for done, image in enumerate(bar, 1):
                into.add(image)
                command.hint = f": {done} of {frames} frames"
                let_interrupt()
        finally:
            size = into.finish()
    return size
