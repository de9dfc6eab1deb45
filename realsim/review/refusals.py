"""What keeps a decision from being recorded: a full disk, a session that is gone."""

import errno

from realsim.errors import InputError

DISK_WORDS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "this user's share of the disk is full",
    errno.EROFS: "the session is on a disk that can only be read",
    errno.EACCES: "this user may not do that there",
    errno.EPERM: "this user may not do that there",
}


class SessionGone(InputError):
    """What was read of a session is not on the disk any more; decisions would be lost."""


def disk_words(error: OSError) -> str:
    """Return in plain words why something could not be read or written."""
    return f"{DISK_WORDS.get(error.errno or 0, 'the system refused it')} ({error})"
