"""What the fit is told."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FitSettings:
    """Budgets are counts of iterations, one photo each; lengths in metres unless said otherwise.

    The rates are about twice those of Kerbl et al. 2023, for budgets of some thousand iterations.
    """

    iterations: int = 8000  # in all
    seed: int = 0  # of every draw
    hold_out_every: int = 8  # photo i of a camera with i % n == n // 2 only measures; 0: none is held out
    # Where it starts.
    start_every: int = 1  # every n-th instant's photos say where surfaces are: less work where photos hardly differ
    start_gaussians: int = 200_000  # of the background
    road_share: float = 0.4  # of the discs on the road, against those elsewhere, how many are taken
    start_node_gaussians: int = 3_000  # of each track, at most
    most_gaussians: int = 250_000  # of a scene
    start_opacity: float = 0.5  # of every Gaussian
    stereo_photos: int = 4  # neighbours compared where lidar does not reach
    sh_degree: int = 0  # 0 to 3
    # Loss.
    ssim_weight: float = 0.1  # loss = (1 - w) L1 + w (1 - SSIM)
    opaque_weight: float = 0.1  # of the mean light that passes where a photo looks at the ground
    # Step sizes of Adam; each falls exponentially to a share of itself.
    rate_end: float = 0.3  # that share, but for mean_rate
    mean_rate: float = 1.6e-3  # times the nearest viewing depth
    quat_rate: float = 4e-3  # of rotations
    scale_rate: float = 2e-2  # of sizes
    opacity_rate: float = 8e-2  # of opacities
    colour_rate: float = 1.2e-2  # of colours
    sky_rate: float = 4e-3  # of the sky map
    exposure_rate: float = 1e-3  # 0: the cameras agree, nothing is aligned
    turn_rate: float = 3e-4  # [rad] of the pose corrections
    shift_rate: float = 1e-3  # [m]
    pose_from: int = 100  # iteration at which poses and boxes start to move
    box_shift_rate: float = 2e-2  # [m] of where boxes are; 0: where they were logged
    box_turn_rate: float = 2e-3  # [rad]
    mean_rate_end: float = 0.15  # that of mean_rate
    # Shape: how often a Gaussian's longest side is its shortest, at most; 0: as often as it likes.
    stretch: float = 0.0  # of the background, but for the road
    box_stretch: float = 2.0  # of what lies in boxes
    # Density: relocation and growth of 3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024).
    refine_every: int = 100  # iterations
    refine_from: int = 300  # iteration
    growth: float = 0.03  # share of Gaussians added each time
    # Road.
    road: bool = True  # Gaussians of the road lie flat on what lidar knows of it

    def __post_init__(self) -> None:
        for name in (
            "iterations",
            "start_every",
            "start_gaussians",
            "start_node_gaussians",
            "most_gaussians",
            "refine_every",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"fit {name} must be 1 or more, not {getattr(self, name)}")
        if self.road_share <= 0.0:
            raise ValueError(f"fit road_share must be above 0, not {self.road_share}")
        if self.sh_degree not in range(4):
            raise ValueError(f"fit sh_degree must be 0 to 3, not {self.sh_degree}")
        for name in ("ssim_weight", "rate_end", "mean_rate_end"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"fit {name} must be from 0 to 1, not {getattr(self, name)}")
        for name in ("stretch", "box_stretch"):
            if getattr(self, name) != 0.0 and not getattr(self, name) >= 1.0:
                raise ValueError(f"fit {name} must be 0 (any) or 1 and more, not {getattr(self, name)}")
