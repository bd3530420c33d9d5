"""What the CPU path imports."""

import subprocess
import sys
from pathlib import Path

from helpers.processes import source_environment
from helpers.recordings import write_replica


def run_python(code: str, *words: str) -> str:
    words = (sys.executable, "-c", code, *words)
    done = subprocess.run(words, env=source_environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_of_the_package_imports_nothing_else() -> None:
    code = "import sys, vtslam; print(sorted({'numpy', 'cv2', 'torch', 'vtslam.common'} & set(sys.modules)))"

    assert run_python(code).strip() == "[]"


def test_every_public_name_is_there_and_the_cpu_path_never_imports_torch(tmp_path: Path) -> None:
    code = (
        "import sys, vtslam, vtslam.services.report, vtslam.services.sensor.sources.sim_room\n"
        "import vtslam.services.supervisor.live_run, vtslam.services.supervisor.child\n"
        "import vtslam.services.sensor.service, vtslam.services.tracker.service, vtslam.services.mapper.service\n"
        "import vtslam.services.archiver.service\n"
        "import vtslam.services.viewer.service, vtslam.services.viewer.rerun_sink, vtslam.services.run_view\n"
        "assert all(getattr(vtslam, name) is not None for name in vtslam.__all__)\n"
        "assert set(vtslam.__all__) <= set(dir(vtslam))\n"
        "vtslam.run(sys.argv[1], sys.argv[2], assignments=['section.length=2'])\n"
        "vtslam.evaluate(sys.argv[2])\n"
        "print('torch' in sys.modules)"
    )

    recording = write_replica(tmp_path / "recording", num_frames=3)
    assert run_python(code, recording.uri, str(tmp_path / "run")).strip() == "False"
