"""What every process shares: geometry, frames, Gaussians, splatting, metrics. No process, no disk format."""
