"""What a person asks about: photos, folders, patterns (`trip/*.jpg`) and videos -> photo files in a fixed order.

Invariant: everything that is asked is a file that can be looked at afterwards; frames of a video are written as JPEG
(quality 95) beside the answers, named by the video and the second.
"""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Sequence
from pathlib import Path

from pipeline.common.errors import DataError, UsageError
from pipeline.common.files import write_atomically
from pipeline.common.text import shown
from pipeline.evaluation.sets.evaluation_set import IMAGE_SUFFIXES, list_images

VIDEOS = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".3gp", ".mts"})


def asked_photos(given: Sequence[str], frames: Path, every: float = 1.0) -> list[Path]:
    """Photo files of what the command line names, each once, in its order; those of a folder or pattern sorted.

    Args:
        frames: folder for the frames of videos.
        every: seconds of a video from frame to frame.

    Raises:
        UsageError: nothing there, or a video without PyAV.
        DataError: an empty folder, a video that cannot be read.
    """
    photos: list[Path] = []
    for word in given:
        path = Path(word)
        if path.exists():
            files = [path]
        elif glob.has_magic(word):
            matches = sorted(Path(match) for match in glob.glob(word, recursive=True))  # noqa: PTH207  absolute ones too
            files = [m for m in matches if m.is_dir() or m.suffix.lower() in IMAGE_SUFFIXES | VIDEOS]
            if not files:
                raise UsageError(f"{shown(word)}: no photo matches this pattern")
        else:
            raise UsageError(f"{shown(word)}: no such photo")
        for file in files:
            if file.is_dir():
                photos += list_images(file)
            elif file.suffix.lower() in VIDEOS:
                photos += video_frames(file, frames, every)
            else:
                photos.append(file)
    return list(dict.fromkeys(photos))


def video_frames(video: Path, folder: Path, every: float) -> list[Path]:
    """The first frame of a video at or after each `every` seconds, upright, as JPEG files in `folder`.

    Raises:
        UsageError: PyAV is not installed; DataError: the video cannot be read.
    """
    try:
        import av
    except ImportError:
        raise UsageError(
            f"{shown(video)}: a video needs PyAV; install it with `pip install av`, or give photos"
        ) from None
    import io

    from PIL import Image

    name = f"{video.stem}-{hashlib.sha256(str(video.resolve()).encode(errors='surrogateescape')).hexdigest()[:8]}"
    written: list[Path] = []
    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise DataError(f"{shown(video)}: no pictures in this video")
            stream = container.streams.video[0]
            start, due = None, 0.0
            for frame in container.decode(stream):
                if frame.time is None:
                    continue
                start = frame.time if start is None else start
                second = frame.time - start
                if second + 1e-6 < due:
                    continue
                due = (second // every + 1) * every
                image: Image.Image = frame.to_image()
                if getattr(frame, "rotation", 0):
                    image = image.rotate(frame.rotation, expand=True)
                data = io.BytesIO()
                image.save(data, "JPEG", quality=95)
                folder.mkdir(parents=True, exist_ok=True)
                written.append(folder / f"{name}-{second:010.3f}s.jpg")
                write_atomically(written[-1], data.getvalue())
    except (av.FFmpegError, ValueError) as error:
        raise DataError(f"{shown(video)}: not a readable video ({shown(error)})") from None
    if not written:
        raise DataError(f"{shown(video)}: no pictures in this video")
    return written
