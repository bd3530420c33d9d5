"""The topics of a recording that this program writes (docs/format-recording.md)."""

COLOR = "/camera/color"
DEPTH = "/camera/depth"
CALIBRATION = "/camera/calibration"
PRIOR = "/camera/pose_prior"
POSE = "/vtslam/pose"
TRANSFORMS = "/tf"
EVENTS = "/vtslam/events"

PROFILE = "vtslam"
WORLD, CAMERA = "world", "camera"  # names of the coordinate frames
DEPTH_SCALE_KEY, FAMILY_KEY = "depth_scale_m", "family"  # metadata of the depth channel
PRIOR_SCHEMA = "vtslam.PosePrior"
