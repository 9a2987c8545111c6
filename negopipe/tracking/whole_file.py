"""Files that are written whole or not at all."""

import os
import tempfile
from pathlib import Path

_UMASK = os.umask(0o022)
os.umask(_UMASK)  # reading it requires setting it


def write_whole(path: Path, content: bytes) -> None:
    """Write a file, and its folder if need be; a process that is killed leaves the earlier file.

    Its permissions are the usual ones of the process, not those of temporary files.
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
