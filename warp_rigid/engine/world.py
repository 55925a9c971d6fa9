"""World: what a simulator consists of, its scenes, settings and device arrays."""

import time
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from warp_rigid.checks import one_of, shown, whole_in
from warp_rigid.engine import pools
from warp_rigid.engine.batch import Shards, plan
from warp_rigid.engine.layout import Layout
from warp_rigid.engine.loading import GRIDS, HEAPS, JOINTS, STEP, load_kernels
from warp_rigid.engine.memory import MemoryLimit, body_bytes, bytes_by_shape, pool_bytes
from warp_rigid.engine.model import Arrays, build_model, initial_environments, initial_state
from warp_rigid.engine.precision import check_precision
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.step import StepOptions
from warp_rigid.engine.teams import team_lanes
from warp_rigid.kernels import declare, schema
from warp_rigid.scene.scene import SURFACE_VELOCITIES
from warp_rigid.scene.shapes import Compound, Mesh


class World:
    """The scenes, the settings and the device arrays of a simulator; `quantities` and `checkpoint` work on it.

    The arguments are those of `Simulator`, which describes them, but for the layout of its scenes.

    Attributes:
        layout: the scene of each environment.
        num_envs: environments.
        settings: of all environments at first.
        device: the Warp device.
        seed: as given.
        on_overflow: as given.
        on_nonfinite: as given.
        memory_limit: what the simulator may take on its device.
        model: what is constant.
        state: what a step changes.
        start: the state to which a reset returns.
        sleep_state: which bodies sleep.
        envs: settings and status of the environments.
        shards: ranges of environments with their pools and recorded steps.
        watches: what the steps record for observers, None for nothing.
        running: whether the surface of any body runs, or did at some time.
        load_seconds: time to load the kernels [s].
    """

    def __init__(
        self,
        layout: Layout,
        settings: Settings,
        device: Any,
        seed: int,
        on_overflow: str,
        on_nonfinite: str,
        memory_limit: int | float | None,
        capacity: Mapping[str, int],
    ) -> None:
        """Check the scenes and the arguments, upload the scenes and load the kernels."""
        for scene in layout.scenes:
            check_precision(scene)
        self.layout, self.settings, self.device = layout, settings, device
        self.num_envs = layout.num_envs
        self.seed = whole_in("seed", seed, 0, 2**63 - 1)
        self.on_overflow = one_of("on_overflow", on_overflow, ("grow", "raise"))
        self.on_nonfinite = one_of("on_nonfinite", on_nonfinite, ("quarantine", "raise"))
        self.memory_limit = MemoryLimit(device, memory_limit)
        sizes = initial_capacity(layout, capacity)
        ranges = plan(layout, sizes, device)
        other_bytes = body_bytes(layout.sizes) + sum(bytes_by_shape(layout).values())
        needed = other_bytes + sum(pool_bytes(some.sizes) for some in ranges)
        self.memory_limit.check(0, needed, f"simulating {self.num_envs} environment(s)")
        lanes = team_lanes(device, self.num_envs, layout.most_bodies, layout.has_joints)
        start = time.perf_counter()
        load_kernels(device, required_by(layout), [lanes])
        self.load_seconds = time.perf_counter() - start
        self.model = build_model(layout, device)
        self.state = initial_state(layout, device)
        self.start = declare.clone(self.state)
        self.sleep_state = declare.allocate(schema.SleepState, layout.sizes, device)
        self.watches: Any = None
        self.running = False
        self.envs: Any = initial_environments(layout, settings, device)
        arrays = Arrays(self.model, self.state, self.sleep_state, self.envs)
        limits = sizes if on_overflow == "raise" else None
        self.shards = Shards(ranges, arrays, limits, self.memory_limit, other_bytes)
        self.choose_step()

    @property
    def lasting(self) -> list[Any]:
        """The structs of all environments whose arrays outlast a step: what a reset and a checkpoint work on."""
        watches = [] if self.watches is None else [self.watches]
        model = self.model
        return [model.bodies, model.fields, self.state, self.sleep_state, self.envs, model.joints, *watches]

    def choose_step(self) -> None:
        """Choose what the step consists of, as the settings require; it is recorded when it is first needed."""
        repetitions = int(self.envs.shock_iterations.numpy().max())
        velocities = [getattr(self.model.bodies, name) for name in SURFACE_VELOCITIES]
        self.running = self.running or any(array.numpy().any() for array in velocities)
        sleeping = bool(self.envs.sleeping.numpy().any())
        self.shards.choose(StepOptions(self.settings.dt, repetitions, sleeping, self.running))


def required_by(layout: Layout) -> list[Any]:
    """Kernel modules that take long to compile, as far as these scenes require them, and those of every step.

    They are compiled at the same time, the slowest first. `Stages` loads the others.
    """
    joints = [import_module(JOINTS)] if layout.has_joints else []
    heaps = HEAPS if layout.is_crowded else ()
    grids = GRIDS if any(isinstance(shape, Mesh | Compound) for shape in layout.shapes) else ()
    return [*joints, *STEP, *heaps, *grids]


def initial_capacity(layout: Layout, given: Mapping[str, int]) -> dict[str, int]:
    """Capacity for pairs and contacts at the start: as given, else six pairs a dynamic body and six contacts a pair."""
    if not isinstance(given, Mapping):
        raise ValueError(f"capacity: must be a dictionary of numbers of pairs and contacts, got {shown(given)}")
    for name in given:
        one_of("capacity", name, pools.NAMES)
    estimate = int(pools.expected_pairs(layout.dynamic_per_env).sum())
    pairs = whole_in("capacity pairs", given.get("pairs", min(estimate, pools.LARGEST)), 1, pools.LARGEST)
    contacts = whole_in("capacity contacts", given.get("contacts", min(6 * pairs, pools.LARGEST)), 1, pools.LARGEST)
    return {"pairs": pairs, "contacts": contacts}
