"""RGB-D SLAM by splatting view-tied 3D Gaussians."""
