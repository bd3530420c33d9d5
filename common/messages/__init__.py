"""Everything that is said on the bus: typed records, and how they become bytes and back."""

from vtslam.common.messages.base import Message
from vtslam.common.messages.codec import Envelope, decode, encode
from vtslam.common.messages.mapping import (
    FrameCommitted,
    LoadOutcome,
    Odometry,
    SectionArchived,
    SectionReply,
    SectionRequest,
    SectionSealed,
    TrackedPose,
    TrackerHistory,
)
from vtslam.common.messages.rules import MessageError, Reason
from vtslam.common.messages.running import Command, Control, FleetEvent, ServiceState, ServiceStatus
from vtslam.common.messages.sensing import Credit, FrameCondition, FrameDescriptor, FramePixels

__all__ = [
    "Command",
    "Control",
    "Credit",
    "Envelope",
    "FleetEvent",
    "FrameCommitted",
    "FrameCondition",
    "FrameDescriptor",
    "FramePixels",
    "LoadOutcome",
    "Message",
    "MessageError",
    "Odometry",
    "Reason",
    "SectionArchived",
    "SectionReply",
    "SectionRequest",
    "SectionSealed",
    "ServiceState",
    "ServiceStatus",
    "TrackedPose",
    "TrackerHistory",
    "decode",
    "encode",
]
