"""An interactive scene: steps in real time, restarts, changes while it runs, pushes and pulls."""

import dataclasses
import math
import time
from typing import Any

import numpy as np

from warp_rigid.engine import joint_quantities
from warp_rigid.engine.field_values import PREFIX
from warp_rigid.engine.quantities import WRITABLE, owner_of
from warp_rigid.engine.settings import Settings
from warp_rigid.engine.simulator import Simulator
from warp_rigid.rotations import inverse, rotate
from warp_rigid.runs import runner
from warp_rigid.scene.shapes import Shape
from warp_rigid.scenes import Verdict
from warp_rigid.viewer.history import QUANTITIES, Moment

PULL_RATE = 8.0
"""Angular frequency of the spring that pulls a body [rad/s]; its damping is critical."""

MOST_BEHIND = 0.1
"""Largest delay behind real time that is caught up [s]."""


class Paced:
    """Lets something be done again only when its cost stays a small share of the time.

    Args:
        share: of one core that it may take.
        period: shortest time between two runs [s].
        patience: longest time between two runs, whatever they cost [s].
    """

    def __init__(self, share: float, period: float = 0.0, patience: float = math.inf):
        """Make it ready immediately."""
        self._share, self._period, self._patience = share, period, patience
        self._next = 0.0

    def __call__(self, action, *arguments) -> Any:
        """Run the action if it is due; None if not."""
        start = time.perf_counter()
        if start < self._next:
            return None
        # Of this thread alone: what other processes take must not count.
        before = time.thread_time()
        result = action(*arguments)
        wait = (time.thread_time() - before) / self._share
        self._next = start + min(max(wait, self._period), self._patience)
        return result


@dataclasses.dataclass
class Pull:
    """A spring from a place on a body to a place in the world."""

    env: int
    body: int
    local: np.ndarray
    target: np.ndarray


class Session:
    """A running scene. One thread uses it; it holds no lock.

    Args:
        source: a built-in scene or a .py file, as for `warp-rigid run`.
        **options: of runner.plan_run: assignments, num_envs, compare, device, seed, substeps, camera.

    Attributes:
        plan: the scene with its simulator at the start.
        sim: the current simulator; a change of dt creates another.
        running: whether `advance` steps.
        speed: simulated seconds per second.
        variant: name of the scene's variant at work, None where settings were changed by hand.

    Raises:
        ValueError: as plan_run.
    """

    def __init__(self, source: str, **options: Any):
        """Build the scene; it does not run yet."""
        self._options = options
        self.running = False
        self.speed = 1.0
        self.open(source, **options)

    def open(self, source: str, **options: Any) -> None:
        """Load another scene on the same device; settings of the last one are discarded."""
        again = ("camera",) if source == getattr(self, "source", None) else ()
        kept = {name: self._options[name] for name in ("device", "seed", *again) if name in self._options}
        demo = runner.find_scene(source)
        self.plan = runner.plan_run(demo, **{**kept, **options})
        self.source = source
        self.sim = self.plan.sim
        self.variant = next(iter(self.variants)) if not options.get("assignments") else None
        self._settings = {name: self.sim.get(name) for name in dataclasses.asdict(self.sim.settings) if name != "dt"}
        self._start = {name: self.sim.get(name) for name in QUANTITIES}
        self._step_seconds = 0.0
        self._begin()

    @property
    def time(self) -> float:
        """Simulated time since the last restart [s]."""
        return self._time_before + self.sim.time

    @property
    def variants(self) -> dict[str, Any]:
        """Changed settings by the names of the scene's variants; a scene without variants has its own settings."""
        return self.plan.demo.variants or {"default": {}}

    @property
    def verdicts(self) -> list[Verdict]:
        """The scene's verdicts as they stand now."""
        return self._outcome.verdicts(self.sim)

    def advance(self, wall: float, budget: float) -> int:
        """Step as far as the wall clock went on, or as far as the budget allows.

        Args:
            wall: time gone by [s].
            budget: most time that stepping should take [s].

        Returns:
            How many steps were done.
        """
        if not self.running:
            return 0
        rate = self.speed / self.sim.settings.dt
        self._owed = min(self._owed + wall * rate, MOST_BEHIND * rate + 1.0)
        affordable = max(1, int(budget / self._step_seconds)) if self._step_seconds else 1
        steps = min(int(self._owed), affordable)
        self._owed -= steps
        self.step(steps)
        return steps

    @property
    def behind(self) -> bool:
        """Whether steps are due that the last `advance` had no time for."""
        return self.running and self._owed >= 1.0

    def step(self, count: int = 1) -> None:
        """Do steps, with the scene's events in their time."""
        if count < 1:
            return
        start = time.perf_counter()
        self._hold_pull()
        runner.step_frame(self.sim, count, self._events)
        each = (time.perf_counter() - start) / count
        # The first step may load kernels; later ones count less the faster they were.
        self._step_seconds = each if not self._step_seconds else self._step_seconds + 0.2 * (each - self._step_seconds)
        self._judge(self._outcome.observe, self.sim)

    def restart(self) -> None:
        """Back to the scene's start; what was set stays."""
        self.release()
        self.sim.reset()
        for name, start in self._start.items():
            if not np.array_equal(self.sim.get(name), start):
                self.sim.set(name, start)
        self._begin()

    def use_variant(self, name: str) -> None:
        """Put the settings back to those of the scene and of one of its variants, and restart."""
        changes = self.variants[name]
        for setting, value in self._settings.items():
            self.sim.set(setting, changes.get(setting, list(value)))
        self.variant = name
        self.restart()

    def change(self, name: str, value: Any, envs: Any = None) -> None:
        """Change a setting, gravity, dt, or a property of all bodies, in some environments.

        Args:
            name: "dt" or a name that Simulator.set takes.
            value: the new value.
            envs: which environments; None for all. `dt` is one for all of them.

        Raises:
            ValueError: as Simulator.set; nothing is changed then.
        """
        if name == "dt":
            self._replace(dataclasses.replace(self.sim.settings, dt=value))
        else:
            self.sim.set(name, value, envs=envs)
        if name in self._settings or name == "dt":
            self.variant = None

    def show(self, moment: Moment) -> None:
        """Put all bodies where they were at a moment, to continue from there; events that have happened stay done."""
        self.release()
        for name, value in moment.state.items():
            self.sim.set(name, value)
        self.sim.internals.model.joints.position.assign(moment.turned)
        _continue_at(self.sim, max(0.0, moment.time - self._time_before))
        self._time_before = moment.time - self.sim.time
        self._owed = 0.0

    def spawn(self, shape: Shape, position: np.ndarray) -> int:
        """Add a body to all environments, whose states are kept.

        Args:
            shape: its shape.
            position: of its frame in every environment (envs, 3) [m].

        Returns:
            The index of the body.
        """
        scene = self.plan.scene
        body = scene.add_body(shape, position=position[0], name=f"added_{len(scene.bodies)}")
        self._replace(self.sim.settings)
        self.sim.set("position", position[:, None], bodies=[body])
        for name in self._start:
            self._start[name] = np.concatenate([self._start[name], self.sim.get(name)[:, body:]], axis=1)
        return body

    def push(self, env: int, body: int, point: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Apply the impulse that would give the body, hit centrally, a change of velocity [m/s].

        Returns:
            The impulse [N s]; zero for bodies that nothing moves.
        """
        impulse = float(self.sim.get("mass")[env, body]) * np.asarray(velocity)
        if impulse.any():
            self.sim.apply_impulse(impulse, point, body, envs=[env])
        return impulse

    def pull(self, env: int, body: int, point: np.ndarray, target: np.ndarray) -> None:
        """Pull a dynamic body from now on: a spring from a point on it to a target, both in the world [m]."""
        self.release()
        orientation = self.sim.get("orientation")[env, body].astype(np.float64)
        back = inverse(orientation)
        local = rotate(back, np.asarray(point) - self.sim.get("position")[env, body])
        self._pull = Pull(env, body, local, np.asarray(target, dtype=np.float64))

    def move_pull(self, target: np.ndarray) -> None:
        """Move the far end of the spring."""
        if self._pull is not None:
            self._pull.target = np.asarray(target, dtype=np.float64)

    def release(self) -> None:
        """Let go of a pulled body."""
        if self._pull is not None:
            self._hold("force", np.zeros(3))
            self._hold("torque", np.zeros(3))
        self._pull = None

    @property
    def pull_ends(self) -> tuple[int, np.ndarray, np.ndarray] | None:
        """Environment and both ends of the spring in the world; None where nothing is pulled.

        Another thread may let go meanwhile.
        """
        pull = self._pull
        return None if pull is None else (pull.env, self._grip(pull), pull.target)

    _pull: Pull | None = None

    def _begin(self) -> None:
        """What a restart does to all that is not the simulator's own."""
        self._pull = None
        self._owed = 0.0
        self._time_before = 0.0
        self._events = sorted(self.plan.demo.events(self.plan.scene), key=lambda event: event[0])
        self._outcome = self.plan.demo.outcome(self.plan.scene)
        self._judge = Paced(share=0.03, patience=0.2)

    def _replace(self, settings: Settings) -> None:
        """Continue in a new simulator of the scene, with all that was set of what the last one had."""
        old = self.sim
        new = Simulator(self.plan.scene, old.num_envs, settings, old.device, old.seed)
        names = [*WRITABLE, *(joint_quantities.WRITABLE if old.scene.joints else ())]
        names += [f"{PREFIX}{name}" for field in old.scene.force_fields for name in field.parameters()]
        for name in names:
            value, now = old.get(name), new.get(name)
            if owner_of(name) != "bodies":
                if not np.array_equal(value, now):
                    new.set(name, list(value) if name in self._settings else value)
            elif not np.array_equal(value, now[:, : old.num_bodies]):
                now[:, : old.num_bodies] = value  # of all bodies: those on paths must not be chosen
                new.set(name, now)
        turned = old.internals.model.joints.position.numpy()  # full turns of hinges, which their bodies do not tell
        new.internals.model.joints.position.assign(turned)
        _continue_at(new, old.time)
        gone = old.time - new.time
        self._events = [(when - gone, act) for when, act in self._events]
        self._time_before += gone
        self.sim = new
        self._step_seconds = 0.0

    def _hold_pull(self) -> None:
        """Set the spring's force on the pulled body for the coming steps."""
        if self._pull is None:
            return
        env, body = self._pull.env, self._pull.body
        mass = float(self.sim.get("mass")[env, body])
        inertia = self.sim.get("inertia")[env, body].astype(np.float64)
        arm = self._grip(self._pull) - self.sim.get("center_of_mass")[env, body]
        spin = self.sim.get("angular_velocity")[env, body].astype(np.float64)
        velocity = self.sim.get("linear_velocity")[env, body] + np.cross(spin, arm)
        wanted = PULL_RATE * (PULL_RATE * (self._pull.target - self._grip(self._pull)) - 2.0 * velocity)
        # A force on the held place accelerates it by more than force / mass: the body gives way by turning.
        cross = np.cross(np.eye(3), arm)
        mobility = np.eye(3) / mass - cross @ np.linalg.inv(inertia) @ cross
        force = np.linalg.solve(mobility, wanted) - mass * self.sim.get("gravity")[env]
        self._hold("force", force)
        self._hold("torque", np.cross(arm, force) - PULL_RATE * (inertia @ spin))

    def _hold(self, name: str, value: np.ndarray) -> None:
        self.sim.set(name, value, envs=[self._pull.env], bodies=[self._pull.body])

    def _grip(self, pull: Pull) -> np.ndarray:
        """The pulled place of the body in the world [m]."""
        orientation = self.sim.get("orientation")[pull.env, pull.body].astype(np.float64)
        return rotate(orientation, pull.local) + self.sim.get("position")[pull.env, pull.body]


def _continue_at(sim: Simulator, time: float) -> None:
    """Let a simulator go on from the step nearest to a time [s], to which paths and waves belong."""
    steps = round(time / sim.settings.dt)
    with sim.in_use():
        sim.internals.shards.steps = steps
        sim.internals.envs.step.fill_(steps)
