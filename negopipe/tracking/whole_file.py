"""Files that are there whole or not at all."""

import os
import tempfile
from pathlib import Path

_UMASK = os.umask(0o022)
os.umask(_UMASK)  # it can only be read by being set


def write_whole(path: Path, content: bytes) -> None:
    """Write a file, its folder too if need be; a process that is killed leaves the file that was there before.

    Who may read it is what is usual for the process's files, not what is usual for temporary ones.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
        try:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            os.chmod(file.name, 0o666 & ~_UMASK)
            os.replace(file.name, path)
        except BaseException:
            Path(file.name).unlink(missing_ok=True)
            raise
