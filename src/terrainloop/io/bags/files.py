"""Which files a bag consists of, whatever its folder, its metadata and its names are."""

import re
from collections.abc import Sequence
from pathlib import Path

import yaml

from terrainloop.errors import TerrainLoopError
from terrainloop.io.recordings import BAG_SUFFIXES

_METADATA = "metadata.yaml"
_LARGEST_METADATA = 16 << 20  # bytes


def find_files(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Files to read, or folders where rosbags must unpack the files, and remarks.

    The metadata of a ROS 2 bag says how its files are compressed. Nothing else in it is needed, so a bag can
    be read without it, or where it was damaged or files were renamed.

    Raises
    ------
    TerrainLoopError
        If there is none, or those of ROS 1 and ROS 2 are mixed.
    """
    found: list[Path] = []
    remarks: list[str] = []
    for path in paths:
        files, words = _files_in(path) if path.is_dir() else ([path], [])
        found += files
        remarks += words
    remarks += [
        f"{file.name}-wal holds messages that are not read: run sqlite3 {file.name} 'PRAGMA wal_checkpoint'"
        for file in found
        if _size(file.with_name(f"{file.name}-wal"))
    ]
    ros1 = [file for file in found if file.suffix.lower() == ".bag"]
    if 0 < len(ros1) < len(found):
        other = next(file for file in found if file not in ros1)
        raise TerrainLoopError(
            expected="bags of ROS 1 or of ROS 2",
            found=f"both: {ros1[0]} and {other}",
            mend="give those of one recording only",
        )
    return found, remarks


def _files_in(folder: Path) -> tuple[list[Path], list[str]]:
    """Files of a bag in a folder, or the folder where its files are compressed."""
    metadata = folder / _METADATA
    text = _text_of(metadata)
    if re.search(r"compression_mode:\s*['\"]?(file|message)\b", text, re.IGNORECASE):
        return [folder], []
    files = sorted(
        file for file in folder.iterdir() if file.suffix.lower() in BAG_SUFFIXES and file.is_file()
    )
    if not files:
        packed = [file.name for file in folder.iterdir() if file.suffix == ".zstd"]
        raise TerrainLoopError(
            expected=f"files of a bag ({' '.join(BAG_SUFFIXES)}) in {folder}",
            found=f"{packed[0]}, packed" if packed else "none",
            mend="unpack them with 'unzstd'" if packed else "copy the whole folder of the bag",
        )
    if metadata.exists():
        missing = sorted(_listed(text) - {file.name for file in files})
        return files, [f"{len(missing)} files that {_METADATA} lists are missing"] if missing else []
    return files, []


def _size(file: Path) -> int:
    return file.stat().st_size if file.is_file() else 0


def _text_of(metadata: Path) -> str:
    try:
        return metadata.read_text(errors="replace") if metadata.stat().st_size <= _LARGEST_METADATA else ""
    except OSError:
        return ""


def _listed(text: str) -> set[str]:
    """Names of the files that the metadata lists; none where it is damaged."""
    try:
        listed = yaml.safe_load(text)["rosbag2_bagfile_information"]["relative_file_paths"]
        return {Path(str(name)).name for name in listed}
    except (yaml.YAMLError, KeyError, TypeError, ValueError, RecursionError):
        return set()
