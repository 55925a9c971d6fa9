"""Start a program with limits on memory and processor time, which ends with the process that waits for it.

This module runs as a script. Its arguments are the largest memory [bytes], the largest processor time [s], the number
of the process that waits, and the program with its arguments.
"""

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1


def start(most_bytes: int, most_seconds: int, parent: int, command: list[str]) -> None:
    """Replace this process by the program. It does not start if the process that waits has ended already."""
    import resource  # exists only where processes have such limits

    for kind, most in ((resource.RLIMIT_AS, most_bytes), (resource.RLIMIT_CPU, most_seconds)):
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() == parent:
        os.execv(command[0], command)


if __name__ == "__main__":
    start(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
