"""Two folders exchange their names in one step, where the system can (Linux, most of its file systems)."""

from __future__ import annotations

import errno
import os
from pathlib import Path

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # fcntl.h, linux/fs.h
_CANNOT = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM)
"""An old kernel, a file system without it, and how containers refuse what they do not know."""


def exchange(one: Path, other: Path) -> bool:
    """Exchange two names of one file system; at no instant is either missing. False: the system cannot.

    renameat2(2). Raises OSError.
    """
    import ctypes

    function = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if function is None:
        return False
    if function(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), ctypes.c_uint(_RENAME_EXCHANGE)) == 0:
        return True
    code = ctypes.get_errno()
    if code in _CANNOT:
        return False
    raise OSError(code, os.strerror(code), str(other))
