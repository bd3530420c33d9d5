"""The command line ``vtslam``: picks the command, and turns refusals into one line and an exit status."""

import os
import sys
from collections.abc import Sequence

from vtslam.services.cli import arguments

# Before NumPy is loaded: its products are of small matrices, and threads that wait for them spin beside the kernels.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

OK, FAILED, USAGE = 0, 1, 2
_INTERRUPTED = 130  # 128 + SIGINT, as shells count


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: The words after ``vtslam``; None takes the process's own.

    Returns:
        0 on success only; 1 for a failure, 2 for wrong arguments or settings, 128 + n after signal n.
    """
    parser = arguments.parser()
    args = parser.parse_args(argv)
    if args.version:
        from vtslam.services.process_facts import program_version

        print(f"vtslam {program_version()}")
        return OK
    if args.command is None:
        parser.print_help(sys.stderr)
        return USAGE
    from vtslam.services.cli.dispatch import execute

    try:
        return execute(args)
    except KeyboardInterrupt:
        print("vtslam: interrupted", file=sys.stderr)
        return _INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
