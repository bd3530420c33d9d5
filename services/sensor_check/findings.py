"""Judges what was seen of a recording: one finding per kind of fault, with what was found and what to do."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from vtslam.services.sensor_check.examination import Evidence

_OUTDOORS = "kitti"
# Usual depths: range of the median, and of the 95th percentile (m).
_INDOOR_M = (0.25, 8.0), (0.9, 15.0)
_OUTDOOR_M = (2.0, 60.0), (6.0, 400.0)
_SCALE_TOLERANCE = 1.3  # what corners and true poses leave open
_SCALES_NEEDED = 5
_SHIFT_SHARE = 0.01  # of the width; colour and depth of good recordings lie up to 4 px of 640 apart
_LAG_FRAMES = 0.75
_FAST_FLOW_SHARE = 0.05  # of the width
_LOST_SHARE = 0.35  # of corners found again
# Sound recordings repeat single frames where the sensor came late, as much as one in ten.
_FROZEN_RUN = 3
_FROZEN_SHARE = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckFinding:
    """One thing that was looked at.

    Attributes:
        name: What.
        ok: Whether nothing wrong was seen.
        found: What was seen, and what to do about it.
        values: The same in numbers.
    """

    name: str
    ok: bool
    found: str
    values: dict[str, float] = field(default_factory=dict)


def judged(evidence: "Evidence", *, family: str) -> list[CheckFinding]:
    """A finding for each kind of fault."""
    focal_lengths = _focal_lengths(evidence)
    return [
        _depth_scale(evidence, family, evidence.scale_errors if focal_lengths.ok else []),
        focal_lengths,
        _principal_point(evidence),
        *_alignment(evidence),
        _frozen(evidence),
        _blank(evidence),
        _motion(evidence),
    ]


def _depth_scale(evidence: "Evidence", family: str, scale_errors: Sequence[float]) -> CheckFinding:
    """By the true poses where they tell, else by what is usual. Wrong focal lengths make the poses tell nothing."""
    name = "depth scale"
    if not evidence.depth_middle_m:
        return CheckFinding(name=name, ok=True, found="cannot be told: no frame has depth")
    middle, far = float(np.median(evidence.depth_middle_m)), float(np.median(evidence.depth_far_m))
    values = {"median_depth_m": middle, "far_depth_m": far}
    seen = f"median {middle:.2f} m, 95 % below {far:.2f} m"
    if len(scale_errors) >= _SCALES_NEEDED:
        error = float(np.median(scale_errors))
        values["depth_over_true"] = error
        ok = error > 0.0 and 1.0 / _SCALE_TOLERANCE < error < _SCALE_TOLERANCE
        if not ok and error > 0.0:
            seen += f"; depth is {error:.2g} times what the true poses make it (look at option depth_scale)"
        elif ok:
            seen += f"; {error:.2f} times what the true poses make it"
        else:
            seen += "; the true poses contradict it"
        return CheckFinding(name=name, ok=ok, found=seen, values=values)
    usual_middle, usual_far = _OUTDOOR_M if family == _OUTDOORS else _INDOOR_M
    ok = usual_middle[0] < middle < usual_middle[1] and usual_far[0] < far < usual_far[1]
    if not ok:
        seen += (
            f"; expected {usual_middle[0]:g} to {usual_middle[1]:g} m and {usual_far[0]:g} to {usual_far[1]:g} m for "
            f"family {family} (look at option depth_scale)"
        )
    return CheckFinding(name=name, ok=ok, found=seen, values=values)


def _focal_lengths(evidence: "Evidence") -> CheckFinding:
    name, camera = "focal lengths", evidence.camera
    seen = f"fx {camera.fx:.1f}, fy {camera.fy:.1f}"
    if len(evidence.unexplained_px) < _SCALES_NEEDED:
        return CheckFinding(name=name, ok=True, found=seen)
    pairs = np.array(evidence.unexplained_px)
    ratio = float(np.median(pairs[:, 0] / np.maximum(pairs[:, 1], 0.05)))
    ok = not (ratio > 1.15 and float((pairs[:, 0] > pairs[:, 1]).mean()) > 0.7)
    if not ok:
        seen += f": swapped? Exchanged, they leave {1.0 / ratio:.0%} of the motion unexplained that they leave now"
    return CheckFinding(name=name, ok=ok, found=seen, values={"error_over_swapped": ratio})


def _principal_point(evidence: "Evidence") -> CheckFinding:
    """Lenses are centred: within a few percent for cameras, a quarter for crops."""
    camera = evidence.camera
    seen = f"cx {camera.cx:.1f}, cy {camera.cy:.1f} of {camera.width}x{camera.height}"
    off = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    swapped_off = max(abs(camera.cy / camera.width - 0.5), abs(camera.cx / camera.height - 0.5))
    if off > 0.08 and swapped_off < 0.5 * off:
        text, ok = f"{seen}: swapped? Exchanged, they are near the middle of the image", False
    elif off > 0.25:
        text, ok = f"{seen}: far from the middle; are these the intrinsics of another image size?", False
    else:
        text, ok = seen, True
    return CheckFinding(name="principal point", ok=ok, found=text, values={"off_centre_share": off})


def _alignment(evidence: "Evidence") -> list[CheckFinding]:
    seen = evidence.edges.alignment()
    if seen is None or not seen.clear:
        text = "cannot be told: edges of colour and depth do not agree anywhere, or are too few"
        return [CheckFinding(name=name, ok=True, found=text) for name in ("registration", "time offset")]
    shift_px = [evidence.reduction * value for value in seen.shift_px]
    apart_px = float(np.linalg.norm(shift_px))
    limit_px = max(_SHIFT_SHARE * evidence.camera.width, 1.5 * evidence.reduction)
    registered = apart_px < limit_px or seen.agreement_here > 0.75
    text = f"colour lies {shift_px[0]:+.1f} px right and {shift_px[1]:+.1f} px below of depth"
    if not registered:
        text += ": not registered; register depth to colour, or look at the intrinsics of both"
    values = {"shift_right_px": shift_px[0], "shift_down_px": shift_px[1]}
    findings = [CheckFinding(name="registration", ok=registered, found=text, values=values)]
    if seen.lag_frames is None:
        findings.append(CheckFinding(name="time offset", ok=True, found="cannot be told: too little motion"))
        return findings
    together = abs(seen.lag_frames) < _LAG_FRAMES or seen.agreement_now > 0.95
    age = "older" if seen.lag_frames < 0.0 else "younger"
    text = f"depth is {abs(seen.lag_frames):.1f} frames {age} than the colour that it comes with"
    if not together:
        text += ": pair them by their times"
    findings.append(
        CheckFinding(name="time offset", ok=together, found=text, values={"depth_late_frames": -seen.lag_frames})
    )
    return findings


def _frozen(evidence: "Evidence") -> CheckFinding:
    parts = [
        f"{what} of {_ids(ids)} is that of the frame before"
        for what, ids in (("colour", evidence.frozen_color), ("depth", evidence.frozen_depth))
        if ids
    ]
    found = "; ".join(parts) or f"none in {evidence.pairs} pairs of successive frames"
    count = max(len(evidence.frozen_color), len(evidence.frozen_depth))
    run = max(_longest_run(evidence.frozen_color), _longest_run(evidence.frozen_depth))
    ok = run < _FROZEN_RUN and count <= max(1.0, _FROZEN_SHARE * evidence.pairs)
    values = {"frozen": float(count), "longest_run": float(run)}
    return CheckFinding(name="frozen frames", ok=ok, found=found, values=values)


def _longest_run(ids: Sequence[int]) -> int:
    """Length of the longest sequence of successive numbers."""
    longest = length = 0
    for place, each in enumerate(ids):
        length = length + 1 if place and each == ids[place - 1] + 1 else 1
        longest = max(longest, length)
    return longest


def _blank(evidence: "Evidence") -> CheckFinding:
    parts = [
        f"{what} of {_ids(ids)}"
        for what, ids in (("colour", evidence.blank_color), ("depth", evidence.blank_depth))
        if ids
    ]
    found = f"nothing to see in the {' and the '.join(parts)}" if parts else f"none in {evidence.frames} frames"
    count = len({*evidence.blank_color, *evidence.blank_depth})
    return CheckFinding(name="blank frames", ok=not parts, found=found, values={"blank": count})


def _motion(evidence: "Evidence") -> CheckFinding:
    if not evidence.flow_share:
        return CheckFinding(name="motion", ok=True, found="cannot be told: too few corners to follow")
    lost = [frame_id for frame_id, share in evidence.followed_share if share < _LOST_SHARE]
    fast = sorted({*lost, *(frame_id for frame_id, share in evidence.flow_share if share > _FAST_FLOW_SHARE)})
    usual, most = (float(value) for value in np.percentile([share for _, share in evidence.flow_share], [50, 95]))
    ok = len(fast) < max(2.0, 0.1 * len(evidence.flow_share))
    found = f"{usual:.1%} of the image's width from frame to frame, 95 % below {most:.1%}"
    if not ok:
        found += f"; too fast at {_ids(fast)}: record at a higher rate, or move slower"
    values = {"flow_share": usual, "flow_share_95": most, "too_fast": len(fast)}
    return CheckFinding(name="motion", ok=ok, found=found, values=values)


def _ids(ids: Sequence[int]) -> str:
    shown = ", ".join(str(each) for each in ids[:4])
    more = f" and {len(ids) - 4} more" if len(ids) > 4 else ""
    return f"frame{'s' if len(ids) > 1 else ''} {shown}{more}"
