"""Arrays as NumPy's NPY and NPZ hold them, read without trusting what their headers announce."""

import io
import zipfile
from collections.abc import Mapping
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Header(NamedTuple):
    """What an NPY stream announces."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def read_header(file: IO[bytes]) -> Header:
    """The header of an NPY stream; raises ValueError if it is not one."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(file)
    if version not in readers:  # 3.0 is for structured types alone
        raise ValueError(f"an NPY file of version {version}")
    shape, _, dtype = readers[version](file)
    return Header(shape, dtype)


def read_array(file: IO[bytes], size: int, kinds: str = "fiu") -> NDArray[Any]:
    """The array of an NPY stream of `size` bytes; its type and size are checked before it is read.

    Parameters
    ----------
    file : binary file
    size : int
        Bytes of the stream.
    kinds : str
        Kinds of types (``dtype.kind``) that the array may have.

    Raises
    ------
    ValueError
        If it is of another kind or size, or no such stream.
    """
    shape, dtype = read_header(file)
    if dtype.kind not in kinds:
        raise ValueError(f"an array of {'objects, which are never loaded' if dtype.hasobject else dtype}")
    announced = file.tell() + int(np.prod(shape, dtype=object)) * dtype.itemsize
    if announced != size:
        raise ValueError(f"an array of shape {str(shape)[:60]} of {dtype} announced, {size} bytes in all")
    file.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def read_member(archive: zipfile.ZipFile, name: str, limit: int, kinds: str = "fiu") -> NDArray[Any]:
    """An array of an NPZ archive that takes at most `limit` bytes; otherwise as `read_array`."""
    info = archive.getinfo(f"{name}.npy")
    # zipfile unpacks BZIP2 and LZMA without bound, and NumPy writes neither.
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"the array {name!r} is packed by another method than NumPy's")
    if info.file_size > limit:
        raise ValueError(f"the array {name!r} of {info.file_size} bytes, {limit} at most")
    with archive.open(info) as file:
        return read_array(file, info.file_size, kinds)


def pack(arrays: Mapping[str, ArrayLike], *, compress: bool) -> bytes:
    """An NPZ archive of arrays."""
    buffer = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()
