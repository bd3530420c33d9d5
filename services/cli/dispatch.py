"""Commands by name; each is imported when it is asked for."""

import sys
from argparse import Namespace

from vtslam.common.bus import BusError
from vtslam.common.config import ConfigError
from vtslam.common.private_folder import PrivateFolderError
from vtslam.common.shm.errors import SharedMemoryError
from vtslam.common.trajectory_io import TrajectoryError
from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.supervisor.errors import FleetError
from vtslam.services.viewer.errors import ViewerError
from vtslam.storage.errors import StorageError

_FAILED, _USAGE = 1, 2


def execute(args: Namespace) -> int:
    """Run the command that ``args`` name; what the user can put right is one line on standard error."""
    try:
        return _command(args)
    except ConfigError as error:
        return _refused(error, _USAGE)
    except (
        SourceError,
        StorageError,
        TrajectoryError,
        SharedMemoryError,
        FleetError,
        BusError,
        PrivateFolderError,
        ViewerError,
    ) as error:
        return _refused(error, _FAILED)
    except BrokenPipeError:
        return _FAILED  # the reader of our output is gone: nobody to tell


def _command(args: Namespace) -> int:
    match args.command:
        case "demo":
            from vtslam.services.cli.demo_command import demo_command

            return demo_command(args)
        case "run":
            from vtslam.services.cli.run_command import run_command

            return run_command(args)
        case "up":
            from vtslam.services.cli.live_commands import up_command

            return up_command(args)
        case "publish":
            from vtslam.services.cli.live_commands import publish_command

            return publish_command(args)
        case "record":
            from vtslam.services.cli.record_command import record_command

            return record_command(args)
        case "status":
            from vtslam.services.cli.status_command import status_command

            return status_command(args)
        case "view":
            from vtslam.services.cli.view_command import view_command

            return view_command(args)
        case "eval":
            from vtslam.services.cli.eval_command import eval_command

            return eval_command(args)
        case "sections":
            from vtslam.services.cli.sections_command import sections_command

            return sections_command(args)
        case "bench":
            from vtslam.services.cli.bench_command import bench_command

            return bench_command(args)
        case "settings":
            from vtslam.services.cli.settings_command import settings_command

            return settings_command(args)
        case "doctor":
            from vtslam.services.cli.doctor_command import doctor_command

            return doctor_command(args)
    raise AssertionError(f"no command {args.command}")


def _refused(error: Exception, status: int) -> int:
    print(f"vtslam: {error}", file=sys.stderr)
    return status
