"""Named points at which a process can be told to die, for tests of what a crash leaves behind.

``VTSLAM_FAILPOINT=NAME:K`` kills the process (SIGKILL) when it passes the point for the K-th time.
"""

import os
import signal

VARIABLE = "VTSLAM_FAILPOINT"

# One at each boundary of the steps in docs/protocol-shm.md, sections 4 to 6, in the order of the steps; then those of
# docs/format-run.md, section 1.
NAMES = (
    "shm.ring.before_claim",
    "shm.ring.after_claim",
    "shm.ring.after_color",
    "shm.ring.after_pixels",
    "shm.ring.after_words",
    "shm.ring.before_publish",
    "shm.ring.after_publish",
    "shm.active.before_rename",
    "shm.active.after_rename",
    "shm.commit.before_reserve",
    "shm.commit.after_reserve",
    "shm.commit.after_frames",
    "shm.commit.after_images",
    "shm.commit.after_ties",
    "shm.commit.after_colors",
    "shm.commit.after_columns",
    "shm.commit.after_moments",
    "shm.commit.before_flip",
    "shm.commit.after_flip",
    "shm.commit.after_trim",
    "shm.adopt.before_epoch",
    "shm.adopt.after_epoch",
    "shm.adopt.after_trim",
    "shm.seal.before_write",
    "shm.seal.after_write",
    "shm.seal.after_tail",
    "shm.seal.after_rename",
    "shm.seal.after_remove",
    "shm.sealed.after_reserve",
    "shm.sealed.after_columns",
    "shm.remove.after_rename",
    "shm.remove.after_files",
    "shm.put.after_write",
    "shm.put.after_link",
    "run.section.before_write",
    "run.section.after_write",
    "run.section.after_catalog",
    "run.section.after_trajectory",
    "run.pack.after_announce",
    "run.pack.after_rename",
)

_armed: str | None = None
_passages_left = 0


def arm(text: str) -> None:
    """Die at the passage that ``NAME:K`` says; the empty text disarms.

    Raises:
        ValueError: There is no such point, or K is no positive number.
    """
    global _armed, _passages_left
    name, _, count = text.partition(":")
    if not text:
        _armed = None
        return
    if name not in NAMES or not count.isdecimal() or int(count) < 1:
        raise ValueError(
            f"{VARIABLE}: expected NAME:K with K of 1 or more and a name of {', '.join(NAMES)}; got {text}"
        )
    _armed, _passages_left = name, int(count)


def reach(name: str) -> None:
    """Pass the point ``name``: nothing happens unless it is armed."""
    global _passages_left
    if _armed is None:
        return
    assert name in NAMES, name
    if name == _armed:
        _passages_left -= 1
        if _passages_left == 0:
            os.kill(os.getpid(), signal.SIGKILL)


arm(os.environ.get(VARIABLE, ""))
