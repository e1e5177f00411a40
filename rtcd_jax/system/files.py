"""Files that are replaced as a whole, and whose errors name them."""

import contextlib
import errno
import fcntl
import json
import math
import os
import socket
import zipfile
import zlib
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Any

from rtcd_jax.system.errors import UserError


def plain(value: Any) -> Any:
    """`value` in JSON's own types, arrays as lists; None where a number is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        import numpy as np

        return value.tolist() if np.all(np.isfinite(value)) else plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    raise TypeError(f"JSON has no {type(value).__name__}: {value!r}")


def user_cache() -> Path:
    """`rtcd_jax` in the user's folder for caches, `$XDG_CACHE_HOME` or ~/.cache."""
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (given if given.is_absolute() else Path(os.path.expanduser("~/.cache"))) / "rtcd_jax"


@contextlib.contextmanager
def held(lock: Path, what: str, advice: str) -> Iterator[None]:
    """Holds `what` by a lock file for this process; the system frees it when the process ends, however it ends.

    Raises:
        UserError: another process holds it, or there can be no such file.
    """
    with contextlib.ExitStack() as stack:
        try:
            file = _lock(stack, lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = lock.read_text().strip() or "another process"
            raise UserError(f"{what} is in use by {holder}: {advice}") from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield


@contextlib.contextmanager
def in_turn(lock: Path) -> Iterator[None]:
    """Waits until no other process is at this, and leaves no file."""
    with contextlib.ExitStack() as stack:
        _lock(stack, lock, fcntl.LOCK_EX)
        with removed(lock):
            yield


@contextlib.contextmanager
def removed(lock: Path) -> Iterator[None]:
    """Removes a lock file that this process holds, at the end."""
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)


def _lock(stack: contextlib.ExitStack, lock: Path, how: int) -> Any:
    """The locked file, open in the stack. Raises BlockingIOError where another process has it, and `how` says not to
    wait.
    """
    while True:
        with writing(lock):
            file = stack.enter_context(lock.open("a+"))
        try:
            fcntl.flock(file, how)
        except BlockingIOError:
            raise
        except OSError as error:
            raise UserError(f"cannot lock {lock}: {error.strerror}") from error
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), lock.stat()):
                return file  # and no file that its holder has just removed


def make_folder(path: Path) -> None:
    """Makes a folder, with its parents, where it is not there. Raises `UserError` if nothing can be written into it."""
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
        if not os.access(path, os.W_OK):  # known before the work, not after it
            raise PermissionError(errno.EACCES, "it is read-only")


def require_own_folder(path: Path, kind: str, owned: bool, besides: Container[str] = ()) -> None:
    """Raises UserError unless a `kind` of result may be written here: a new or empty folder, or one it `owned` before.

    Temporary files and those named in `besides` do not count.
    """
    if path.exists() and not path.is_dir():
        raise UserError(f"{path} is a file: {kind} needs a folder")
    if owned or not path.exists():
        return
    foreign = sorted(item.name for item in path.iterdir() if item.name not in besides and not is_temporary(item))
    if foreign:
        raise UserError(f"{path} is not empty and not {kind}: it has {', '.join(foreign[:5])}; choose another folder")


def replace_json(path: Path, record: Mapping[str, Any]) -> None:
    """`replace` by JSON that a human can read, with null for what is not finite."""
    text = json.dumps(plain(record), indent=2, allow_nan=False, ensure_ascii=False)
    replace(path, f"{text}\n".encode())


def replace(path: Path, content: bytes) -> None:
    """The old file or the new one, never a part, whenever the process or the machine stops."""
    temporary = path.with_name(f".{path.name}.tmp")
    with writing(path):
        try:
            with temporary.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:  # a disk that is full, or Ctrl-C: no half file stays
            temporary.unlink(missing_ok=True)
            raise
    sync(path.parent)


def sync(path: Path) -> None:
    """Waits until a file, or a folder's list of files, is on disk."""
    with writing(path):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_json(path: Path, advice: str) -> dict[str, Any]:
    """The object in a JSON file. Raises `UserError` as `reading` does."""
    with reading(path, advice):
        if path.exists() and not path.is_file():  # a pipe would be waited for
            raise TypeError("it is no file")
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise TypeError(f"must be a JSON object, is {content!r:.40}")
        return content


_DAMAGED = OSError, EOFError, KeyError, TypeError, ValueError, RecursionError, NotImplementedError
"""What Python's and numpy's readers raise over bytes that nobody has written."""


@contextlib.contextmanager
def reading(path: Path, advice: str) -> Iterator[None]:
    """Turns what a damaged file raises into one error that names it and ends with `advice`."""
    try:
        yield
    except UserError:
        raise
    except (*_DAMAGED, zipfile.BadZipFile, zlib.error) as error:
        lacks = "it lacks " if isinstance(error, KeyError) else ""
        reason = getattr(error, "strerror", None) or lacks + " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"cannot read {path}: {reason}; {advice}") from error


@contextlib.contextmanager
def writing(path: Path, kinds: tuple[type[Exception], ...] = (OSError,)) -> Iterator[None]:
    """Turns the system's errors into one that names the path and can be shown as it is."""
    try:
        yield
    except UserError:
        raise
    except kinds as error:
        raise UserError(f"cannot write {path}: {getattr(error, 'strerror', None) or error}") from error


def is_temporary(path: Path) -> bool:
    """True for what `replace` leaves behind if it is killed."""
    return path.name.startswith(".") and path.suffix == ".tmp"
