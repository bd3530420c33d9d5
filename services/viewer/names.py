"""The names of what is shown, as the core gives them and the blueprint arranges them."""

WORLD = "world"
CAMERA = f"{WORLD}/camera"
INPUT = f"{CAMERA}/input"
MAP = f"{WORLD}/map"
ACTIVE_MAP = f"{MAP}/active"
PATHS = f"{WORLD}/path"
ACTIVE_PATH = f"{PATHS}/active"
TRUE_PATH = f"{PATHS}/true"

STATES = "states"  # apart from the world, which shows the same sections in their own colours
ACTIVE_STATE = f"{STATES}/active"

RENDERED, RESIDUAL, DEPTH = "frame/rendered", "frame/residual", "frame/depth"

FIGURES = "figures"
PLOTS = {  # below `FIGURES`, and what they are called
    "latency": "milliseconds per frame",
    "loss": "losses",
    "quality": "PSNR of the frame (dB)",
    "error": "position error (mm)",
    "memory": "memory (MB)",
    "drops": "dropped, missed, dead",
    "sections": "sections",
}
LIVE_PLOTS = ("memory", "drops")
EVENTS = "events"


def of_section(section_id: int) -> str:
    """The last part of a section's names."""
    return f"{section_id:06d}"
