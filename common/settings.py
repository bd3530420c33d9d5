"""The settings tree: schedule (how) times family (what kind of recording), every key typed and bounded.

The defaults below are the figures of family ``tum`` under schedule ``paper``; presets in ``common/presets`` state what
differs. Figures come from the paper's implementation details and its authors' program.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from vtslam.common.config import Range

Positive = Annotated[float, Range(0.0, low_open=True)]
NonNegative = Annotated[float, Range(0.0)]
Fraction = Annotated[float, Range(0.0, 1.0)]
Decay = Annotated[float, Range(0.0, 0.99999)]
Count = Annotated[int, Range(0)]
PositiveCount = Annotated[int, Range(1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceSettings:
    """What of the source is used; empty values keep the source's own.

    Attributes:
        size: "WxH" to scale frames to.
        frames: "A:B", the part of the recording.
        noise: Depth and colour noise of a simulated source.
        seed: Seed of a simulated source.
        poses: Poses from elsewhere, as priors: a trajectory file (TUM), or a topic of transforms in the recording.
        poses_sigma: "M,DEG", their standard deviations per axis.
    """

    size: str = ""
    frames: str = ""
    noise: Literal["", "none", "kinect", "stereo"] = ""
    seed: Annotated[int, Range(-1, 2**31)] = -1
    poses: str = ""
    poses_sigma: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatSettings:
    """The rasteriser.

    Attributes:
        engine: Which one.
        threads: Threads of the CPU engine; 0 for one per available core.
        low_pass_px2: Added to the diagonal of the image covariance, px^2.
        near_m: Gaussians nearer than this are not drawn.
        alpha_cap: Upper bound of one Gaussian's alpha.
    """

    engine: Literal["native", "gsplat", "reference"] = "native"
    threads: Annotated[int, Range(0, 256)] = 0
    low_pass_px2: Annotated[float, Range(0.0, 10.0)] = 0.001
    near_m: Positive = 0.2
    alpha_cap: Annotated[float, Range(0.5, 0.9999)] = 0.999


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionSettings:
    """How the stream is cut into sections.

    Attributes:
        length: Frames of a section, N; the most it has if length_m ends it.
        length_m: A section also ends once its frames have travelled so far, metres; 0 for any distance.
        candidate_interval: Every so many frames one answers overlap questions, N_1.
    """

    length: Annotated[int, Range(2, 10000)] = 30
    length_m: NonNegative = 0.0
    candidate_interval: PositiveCount = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class OverlapSettings:
    """Choice of the overlapping section (paper, section 3.3).

    Attributes:
        gamma: Share of the frame's points a candidate view must see.
        gamma_decay: Factor on gamma while too few sections pass.
        gamma_floor: Gamma below which the search ends.
        depth_consistency: Relative depth difference up to which a point counts as seen.
        border_share: Image border that does not count, as a share of the width.
        max_sections: Sections that are pre-tracked.
        loss_tolerance: The earliest section wins whose loss per pixel is at most this many times the least.
        skip_previous: Leave out the previous section's views but its head's, as the authors' program does.
    """

    gamma: Fraction = 0.26
    gamma_decay: Annotated[float, Range(0.1, 0.99)] = 0.8
    gamma_floor: Annotated[float, Range(0.0, 1.0, low_open=True)] = 0.01
    depth_consistency: Annotated[float, Range(0.0, 1.0, low_open=True)] = 0.01
    border_share: Annotated[float, Range(0.0, 0.4)] = 0.03125
    max_sections: PositiveCount = 3
    loss_tolerance: Annotated[float, Range(1.0, 10.0)] = 1.0
    skip_previous: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class AdamSettings:
    """Pose by first-order descent on Eq. 1, as the paper does it.

    Attributes:
        iterations: Renders of a frame.
        first_section_iterations: The same within section 0.
        pretrack_iterations: Renders per candidate section of a head.
        learning_rate_rotation: On the unnormalised quaternion.
        learning_rate_translation: Metres.
        silhouette_threshold: Pixels need a silhouette above this.
        silhouette_adaptive: Choose the threshold per frame by the colour error at the first guess.
        color_weight: Alpha of Eq. 1.
        depth_weight: Beta of Eq. 1.
    """

    iterations: PositiveCount = 200
    first_section_iterations: PositiveCount = 200
    pretrack_iterations: PositiveCount = 31
    learning_rate_rotation: Positive = 0.002
    learning_rate_translation: Positive = 0.002
    silhouette_threshold: Fraction = 0.99
    silhouette_adaptive: bool = False
    color_weight: NonNegative = 0.5
    depth_weight: NonNegative = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussNewtonSettings:
    """Pose by damped Gauss-Newton on the robust, masked form of Eq. 1: few renders, coarse to fine.

    Attributes:
        renders: Renders of a frame at most; each is aligned to the frame until that converges.
        levels: Image pyramid levels at most; the coarsest is 2^(levels-1) times smaller, but no less than 15 px.
        iterations: Steps per level at most.
        converged_m: A step smaller than this, in metres, ends a level ...
        converged_rad: ... if its rotation is smaller than this too.
        silhouette_threshold: Pixels need a silhouette above this.
        color_sigma: Scale at which colour residuals (0..1) stop being quadratic.
        color_weight: Weight of colour against depth.
        depth_weight: Weight of depth.
        depth_sigma_base_m: Depth noise at 0 m ...
        depth_sigma_per_m: ... and its growth with the square of depth (1/m).
        depth_gate_sigmas: Pairs further apart than this are taken for occlusions.
    """

    renders: PositiveCount = 3
    levels: Annotated[int, Range(1, 6)] = 5
    iterations: PositiveCount = 10
    converged_m: Positive = 1e-4
    converged_rad: Positive = 5e-5
    silhouette_threshold: Fraction = 0.9
    color_sigma: Positive = 0.03
    color_weight: NonNegative = 0.05
    depth_weight: NonNegative = 1.0
    depth_sigma_base_m: Positive = 0.002
    depth_sigma_per_m: NonNegative = 0.0015
    depth_gate_sigmas: Positive = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerSettings:
    """Pose of a frame (paper, section 3.3).

    Attributes:
        enabled: Whether frames are tracked that come with a pose; otherwise they are mapped there.
        optimizer: Which one.
        visibility: Mask heads by what the overlapping section's first, middle and last frame saw.
        visibility_tolerance: Relative depth difference up to which a pixel counts as seen.
        far_factor: Depth beyond this many times the mean of the 30 largest mean depths is left out; 0 keeps all.
        rescue_factor: Loss at the guess over the usual loss, above which RGB-D odometry is asked.
        weak_covered_share: Below this share of usable pixels the pose is called weak.
        lost_covered_share: Below this it is called lost.
        lost_loss_factor: Final loss over the usual loss, above which it is called lost.
    """

    enabled: bool = True
    optimizer: Literal["adam", "gauss_newton"] = "adam"
    visibility: bool = True
    visibility_tolerance: Annotated[float, Range(0.0, 1.0, low_open=True)] = 0.01
    far_factor: NonNegative = 1.5
    rescue_factor: Positive = 50.0
    weak_covered_share: Fraction = 0.1
    lost_covered_share: Fraction = 0.01
    lost_loss_factor: Positive = 20.0
    adam: AdamSettings = field(default_factory=AdamSettings)
    gauss_newton: GaussNewtonSettings = field(default_factory=GaussNewtonSettings)
    overlap: OverlapSettings = field(default_factory=OverlapSettings)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapperSettings:
    """Growth and optimisation of the active section (paper, sections 3.4 and 3.5).

    Attributes:
        iterations_head: Optimiser steps at a head.
        iterations_regular: Optimiser steps at another frame.
        iterations_seal: Steps over all frames of a section when it is finished.
        seal_rate_first: Factor on the learning rates at the first of those ...
        seal_rate_last: ... and at the last, geometric in between.
        enough_loss: Steps on a frame end early once the last few losses (Eq. 2) lie below this; 0 never.
        budget_s: Steps on a frame end once it has taken this long, tracking included; the map then depends on the
            machine. 0 for no limit.
        learning_rate_color: Adam's rate of colours.
        learning_rate_log_radius: ... of log radii.
        learning_rate_opacity: ... of opacity logits.
        adam_momentum: Decay of Adam's first moment; few steps want a small one.
        adam_memory: Decay of its second moment.
        adam_epsilon: Adam's epsilon; a larger one keeps Gaussians that hardly show where they started.
        radius_limit: Largest factor between a radius and its first value; 0 for none.
        keep_moments: Keep Adam's moments from frame to frame of a section.
        color_weight: Weight of the colour terms, of Eq. 2.
        depth_weight: Sigma of Eq. 2.
        ssim_share: Share of the structural term in the colour terms.
        neighbour_weight: Weight of the loss with the previous and overlapping sections (Eq. 2); 0 leaves it out.
        exposure: Estimate each frame's exposure and white balance; without, all frames count as taken alike.
        depth_factor: Factor on depth when Gaussians are placed.
        initial_opacity: Opacity of a new Gaussian.
        initial_radius: Radius of a new Gaussian over depth / focal length (Eq. 3).
        border_radius: Factor on the radius of Gaussians at the image border: nothing was seen beyond it.
        edge_supplement: Add four half-size Gaussians on edge pixels.
        edge_low: Lower Canny threshold.
        edge_high: Upper Canny threshold.
        least_weight: A new Gaussian whose blending weights in its own frame add up to less (pixels) goes; 0 keeps all.
        least_weight_sealed: When a section is finished, a Gaussian whose weights add up to less in each of its frames
            goes; 0 keeps all.
        uncovered_silhouette: Pixels with a smaller silhouette get Gaussians.
        uncovered_depth_factor: So do those whose rendered depth lies behind by this many median errors; 0 never.
        uncovered_color_error: So do those whose mean channel difference is larger than this; 0 never.
        rate_weight: Pull of colours, radii and opacities towards their first values, which dense section files store
            for less, as a share of Adam's longest step; 0 for none.
        bundle_rotation_rate: Adam's rate of a head's rotation while it is mapped, radians; 0 keeps it.
        bundle_translation_rate: The same for its translation, metres.
    """

    iterations_head: Count = 30
    iterations_regular: Count = 30
    iterations_seal: Count = 0
    seal_rate_first: Positive = 1.0
    seal_rate_last: Positive = 1.0
    enough_loss: NonNegative = 0.0
    budget_s: NonNegative = 0.0
    learning_rate_color: NonNegative = 0.0025
    learning_rate_log_radius: NonNegative = 0.005
    learning_rate_opacity: NonNegative = 0.05
    adam_momentum: Decay = 0.9
    adam_memory: Decay = 0.999
    adam_epsilon: Positive = 1e-15
    radius_limit: NonNegative = 0.0
    keep_moments: bool = False
    color_weight: NonNegative = 1.0
    depth_weight: NonNegative = 1.0
    ssim_share: Fraction = 0.2
    neighbour_weight: NonNegative = 1.0
    exposure: bool = False
    depth_factor: Annotated[float, Range(0.9, 1.1)] = 1.0
    initial_opacity: Annotated[float, Range(0.01, 0.99)] = 0.5
    initial_radius: Annotated[float, Range(0.1, 3.0)] = 1.0
    border_radius: Annotated[float, Range(0.1, 1.0)] = 1.0
    edge_supplement: bool = False
    edge_low: NonNegative = 50.0
    edge_high: NonNegative = 200.0
    least_weight: NonNegative = 0.0
    least_weight_sealed: NonNegative = 0.0
    uncovered_silhouette: Fraction = 0.5
    uncovered_depth_factor: NonNegative = 50.0
    uncovered_color_error: NonNegative = 0.0
    rate_weight: Fraction = 0.0
    bundle_rotation_rate: NonNegative = 1e-4
    bundle_translation_rate: NonNegative = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetSettings:
    """The processes of a run; `pacing` and `lead` change results, and so does a tight `map_budget_mb`.

    Attributes:
        pacing: Who waits for whom: each frame is tracked once those before it are mapped (lockstep), or while the one
            before it is (pipelined), or nobody waits and frames are dropped (realtime). Empty: lockstep for
            recordings, realtime for what publishers send.
        lead: Frames that tracking is ahead of mapping when pipelined.
        replay_hz: Frames per second of a recording in realtime; 0 as they were captured.
        tracker_threads, mapper_threads: Threads of these processes; 0 as splat.threads, and half the cores each in
            realtime.
        map_budget_mb: Shared memory for the map, 10^6 bytes; finished sections leave it for the run folder as needed,
            and a section ends early before it is too large to be mapped in it.
        hang_s: A process whose work loop is silent for so long is killed and started again; more than any step takes.
        metrics_port: Where 127.0.0.1 answers Prometheus; 0 for nowhere.
    """

    pacing: Literal["", "lockstep", "pipelined", "realtime"] = ""
    lead: Annotated[int, Range(1, 3)] = 1
    replay_hz: Annotated[float, Range(0.0, 1000.0)] = 0.0
    tracker_threads: Annotated[int, Range(0, 256)] = 0
    mapper_threads: Annotated[int, Range(0, 256)] = 0
    map_budget_mb: Annotated[int, Range(1, 10**7)] = 4000
    hang_s: Annotated[float, Range(5.0, 86400.0)] = 300.0
    metrics_port: Annotated[int, Range(0, 65535)] = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ArchiverSettings:
    """The process of a fleet that writes the run folder; nothing here changes results.

    Attributes:
        load_timeout_s: How long tracker and mapper wait for a section that left memory, until they read its file
            themselves; at most half of `fleet.hang_s`.
        prefetch: So many sections near to where the camera will be are brought back before they are asked for.
    """

    load_timeout_s: Annotated[float, Range(0.01, 3600.0)] = 10.0
    prefetch: Annotated[int, Range(0, 16)] = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class StorageSettings:
    """Section files.

    Attributes:
        codec: How a finished run leaves them: raw and lossless keep every bit, fast and dense round learned attributes.
            While a run lasts they are lossless, so that the map does not depend on which sections were read again.
        coarseness: Factor on the steps that dense rounds to; 1 costs less than 0.1 dB, 2 about 0.2 dB.
    """

    codec: Literal["raw", "lossless", "fast", "dense"] = "lossless"
    coarseness: Annotated[float, Range(0.1, 10.0)] = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderSettings:
    """The recording of a run, in an MCAP file beside what the run itself leaves.

    Attributes:
        file: The file to make; empty for none.
        color: Colour without loss (png), or several times smaller (jpeg). Depth is always without loss.
        jpeg_quality: Of such colour.
    """

    file: str = ""
    color: Literal["png", "jpeg"] = "png"
    jpeg_quality: Annotated[int, Range(1, 100)] = 95


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewerSettings:
    """What is shown of a run while it lasts, by a process that nobody waits for; results do not depend on it.

    Attributes:
        web_port: Where 127.0.0.1 answers browsers; the page's data come from the port after it. 0 for nowhere.
        save: A file (.rrd) to keep what is shown in; empty for none.
        idle: Run only where nobody else wants to; on a machine without time to spare, it then shows next to nothing.
        cpu_share: Of one core, that the viewer takes at most over time.
        section_gaussians: Gaussians of a section that are sent at most ...
        gaussians: ... and of all sections together; beyond a fifth of that, they are sent as points.
    """

    web_port: Annotated[int, Range(0, 65534)] = 0
    save: str = ""
    idle: bool = True
    cpu_share: Annotated[float, Range(0.001, 1.0)] = 0.2
    section_gaussians: Annotated[int, Range(100, 10**7)] = 20_000
    gaussians: Annotated[int, Range(1000, 10**8)] = 2_000_000

    @property
    def is_wanted(self) -> bool:
        """Whether there is to be a viewer."""
        return self.web_port > 0 or self.save != ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """All settings of a run.

    Attributes:
        seed: Key of every random choice.
        holdout: Every so many regular frames one is tracked but kept out of mapping; 0 none.
        source, splat, section, tracker, mapper, storage, fleet, archiver, recorder, viewer: The parts.
    """

    seed: Annotated[int, Range(0, 2**31)] = 2
    holdout: Count = 0
    source: SourceSettings = field(default_factory=SourceSettings)
    splat: SplatSettings = field(default_factory=SplatSettings)
    section: SectionSettings = field(default_factory=SectionSettings)
    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    mapper: MapperSettings = field(default_factory=MapperSettings)
    storage: StorageSettings = field(default_factory=StorageSettings)
    fleet: FleetSettings = field(default_factory=FleetSettings)
    archiver: ArchiverSettings = field(default_factory=ArchiverSettings)
    recorder: RecorderSettings = field(default_factory=RecorderSettings)
    viewer: ViewerSettings = field(default_factory=ViewerSettings)
