"""`python -m planners serve planner=<training>`: a planner for somebody else's simulator or evaluation.

protocol=navsim     for NAVSIM's own evaluation, whose agent starts this: nobody does by hand
protocol=alpasim    a driver of AlpaSim: gRPC at host:port until SIGTERM, docs/alpasim.md
"""

from dataclasses import dataclass
from typing import Literal

from planners.navsim.serve import answer_agent


@dataclass(frozen=True)
class Request:
    """The command line."""

    planner: str  # a training's folder, a+b, constant_velocity, or my.module:MyPlanner; it reads pictures, status alone
    protocol: Literal["navsim", "alpasim"] = "navsim"
    device: str = "cpu"  # or cuda
    cameras: tuple[str, ...] = ()  # in the places of those it was trained on, left to right: [cam_l0,cam_f0]
    undistort: bool = False  # for a planner that was trained on pinhole pictures; of navsim
    host: str = "127.0.0.1"  # this and what follows: of alpasim; 0.0.0.0 lets other machines in
    port: int = 6789  # 0 for a free one
    command: Literal["trained", "curvature", "simscale"] = "trained"  # by which rule it is told where the route goes
    batch: int = 1  # plans at a time, of several sessions; above 1 rounding depends on who else asks
    batch_wait_ms: int = 2  # for others, of larger batches

    def __post_init__(self) -> None:
        """Raises ValueError for numbers that cannot be, and undistort without a lens to know."""
        if not (0 <= self.port < 1 << 16 and 1 <= self.batch <= 64 and 0 <= self.batch_wait_ms <= 1000):
            raise ValueError("port=0..65535, batch=1..64 and batch_wait_ms=0..1000 are expected")
        if self.undistort and self.protocol == "alpasim":
            raise ValueError("undistort=true: AlpaSim does not say how its lenses distort")


def main(request: Request) -> None:
    """Answer until nobody asks any more. Raises Refused, ConfigError for a planner that cannot plan there."""
    if request.protocol == "navsim":
        answer_agent(request.planner, request.device, request.cameras, request.undistort)
        return
    from planners.alpasim.driver import Driver, serve

    command = None if request.command == "trained" else request.command
    wait_s = request.batch_wait_ms / 1000.0
    driver = Driver(request.planner, request.device, request.cameras, command, request.batch, wait_s)
    serve(driver, request.host, request.port)
