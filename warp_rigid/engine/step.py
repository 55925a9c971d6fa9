"""The step as a sequence of kernel launches, recorded once and replayed."""

import functools
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warp_rigid.engine import loading, teams
from warp_rigid.engine.hash_grid import HashGrid
from warp_rigid.engine.heaps import HeapStages
from warp_rigid.engine.joints import JointStages
from warp_rigid.engine.model import Arrays
from warp_rigid.engine.pools import CONTACTS, NEAR_SAMPLES, PAIRS, Pools
from warp_rigid.engine.step_parts import StepParts, useful_workers
from warp_rigid.kernels import declare, schema
from warp_rigid.kernels.collide import broadphase, ccd, narrowphase, overlap, pair_contacts, touches
from warp_rigid.kernels.common import capacity
from warp_rigid.kernels.constraints import build_contacts
from warp_rigid.kernels.enums import IslandSolver, SolverPart
from warp_rigid.kernels.graph import coloring, islands, support
from warp_rigid.kernels.solve import contact_solver, push_out, restitution
from warp_rigid.kernels.update import ground_motion, integrate, paths, predict, sleep, watch

AT_REST = 0.05
"""Speed below which a body counts as resting [m/s]."""

STAGES: list[str] = []
"""Names of the stages of a step, in order of definition."""


def stage(method: Callable[..., None]) -> Callable[..., None]:
    """Mark a method of `Stages` as a stage of the step; `Stages.on_stage` is called when it starts and ends."""
    STAGES.append(method.__name__)

    @functools.wraps(method)
    def run(self: "Stages", *arguments: Any, **named: Any) -> None:
        outer, self.current_stage = self.current_stage, method.__name__
        self.on_stage(method.__name__)
        method(self, *arguments, **named)
        self.current_stage = outer
        self.on_stage(outer)

    return run


def ignore_stage(name: str | None) -> None:
    """Do nothing (for a step that is not profiled)."""


class StepOptions(NamedTuple):
    """What a step consists of.

    Attributes:
        dt: time step [s].
        repetitions: largest number of shock iterations in any environment.
        sleeping: whether sleeping is enabled in any environment.
        running: whether the surface of any body runs.
    """

    dt: float
    repetitions: int
    sleeping: bool
    running: bool


class Stages:
    """The stages of a step over one set of arrays; a change of the pools requires a new object.

    Args:
        arrays: the scenes and their state.
        pools: pairs, contacts and graph.
        options: what the step consists of.
        watches: what is recorded in every step; None for nothing.
        workers: threads that share the rows of a crowded environment on a CPU.
    """

    def __init__(self, arrays: Arrays, pools: Pools, options: StepOptions, watches: Any, workers: int) -> None:
        """Record the step; the kernels that the scenes require must be loaded (`World`)."""
        self.model, self.state, self.sleep_state, self.envs = arrays
        self.dt, self.repetitions, self.sleeping, running = options
        self.pools, self.watches, model = pools, watches, self.model
        self.on_stage: Callable[[str | None], None] = ignore_stage
        self.current_stage: str | None = None
        self.device: Any = pools.wanted.device
        layout, sizes = model.layout, model.layout.sizes
        self.num_envs, self.rows, self.surface_vertices = layout.num_envs, sizes["bodies"], sizes["vertices"]
        self.has_surface_velocity = running or self.surface_vertices > 0
        self.bounded = any(scene.bounds is not None for scene in layout.scenes)
        self.crowded = layout.is_crowded
        self.lanes = teams.team_lanes(self.device, self.num_envs, layout.most_bodies, layout.has_joints)
        self.listing_lanes, self.choosing_lanes = teams.search_lanes(layout.has_many_samples, self.crowded)
        self.motions = declare.allocate(schema.Motions, pools.sizes, self.device)
        self.moving = [self.dt, model.shapes, model.bodies, self.state, self.motions]
        self.kept: Any = declare.allocate(schema.History, pools.sizes, self.device) if self.sleeping else None
        self.parts = StepParts(self.device, useful_workers(workers, layout.most_bodies) if self.crowded else 1)
        # A cycle of references would keep all arrays until the garbage collector runs.
        of_step = weakref.proxy(self)
        self.grid, self.joints, self.heaps = HashGrid(of_step), JointStages(of_step), HeapStages(of_step)
        optional = (
            (loading.SLEEP, self.sleeping),
            (loading.GROUND, self.has_surface_velocity),
            (loading.PATHS, sizes["paths"] > 0),
            (loading.CANDIDATES, self.grid.buckets > 0),
            (loading.WATCH, watches),
        )
        modules = [module for modules, used in optional if used for module in modules]
        loading.load_kernels(self.device, modules, [self.lanes])
        with self.parts.recorded():
            self.step()

    def replay(self) -> None:
        """Execute one step."""
        self.parts.replay()

    def step(self) -> None:
        """Execute one step of the method (Guendelman et al. 2003, section 4), with the extensions of each stage."""
        self.move_ground()
        self.follow_paths()
        self.predict(self.dt)
        if self.sleeping:
            self.wake_changed_islands()
        self.find_pairs()
        self.find_contacts()
        self.build_graph()
        self.integrate_velocities(after_impacts=False)
        self.set_surface_velocity(before_step=True)
        self.solve_impacts()
        self.integrate_velocities(after_impacts=True)
        if self.surface_vertices:
            self.set_surface_velocity(before_step=False)
        self.solve_contacts()
        self.push_out()
        self.detect_continuous_collisions()
        self.integrate_positions()
        if self.watches:
            self.record_watches()
        if self.sleeping:
            self.update_sleep()
        self.store_history()

    @stage
    def move_ground(self) -> None:
        """Moving ground: compute the current heights and velocities."""
        if self.surface_vertices:
            inputs = [self.dt, self.model.surface_node, self.envs, self.model.surfaces]
            self.launch(ground_motion.move_ground, self.surface_vertices, inputs, [self.model.shapes])

    @stage
    def follow_paths(self) -> None:
        """Paths: place the kinematic bodies that follow a path, and set their velocities."""
        count = self.model.layout.sizes["paths"]
        if count:
            inputs = [self.dt, self.model.paths, self.model.bodies, self.envs]
            self.launch(paths.follow_paths, count, inputs, [self.state])

    @stage
    def set_surface_velocity(self, before_step: bool) -> None:
        """Surface velocity: that of running surfaces and of the ground, which is that before or after the step."""
        if self.has_surface_velocity:
            model, contacts = self.model, self.pools.contacts
            inputs = [int(before_step), model.surface_node, self.dt, model.shapes, model.bodies, self.state]
            inputs += [self.envs, self.motions, model.surfaces, self.pools.pairs]
            self.launch(ground_motion.set_surface_velocity, contacts.key.shape[0], inputs, [contacts])

    @stage
    def predict(self, dt: float) -> None:
        """Prediction: derive world quantities and swept bounding boxes from the state."""
        model = self.model
        inputs = [dt, model.shapes, model.bodies, self.state, self.sleep_state, self.envs, model.fields]
        self.per_body(predict.derive_motion, inputs, [self.motions])
        self.joints.bound_travel()
        if self.surface_vertices:
            inputs = [model.shapes, model.bodies, self.envs]
            self.per_body(ground_motion.drive_ground, inputs, [self.motions])

    @stage
    def find_pairs(self) -> None:
        """Broad phase: count the pairs with overlapping boxes, sum the counts, and write the pairs."""
        pairs = self.pools.pairs
        self.grid.update()
        self._search_pairs(write=0)
        self._sum(pairs.count, pairs.start, PAIRS, pairs.body_a.shape[0])
        self._search_pairs(write=1)

    @stage
    def find_contacts(self) -> None:
        """Narrow phase: find touching samples, reduce them, and build contact rows."""
        pairs, contacts = self.pools.pairs, self.pools.contacts
        pairs.contact_count.zero_()
        self.pools.near.count.zero_()
        self._search_contacts(woken=0)
        if self.sleeping:
            self.launch(sleep.wake_touched, self.pools.sizes["pairs"], [pairs], [self.sleep_state])
            self.per_body(sleep.wake_islands, [self.model.bodies], [self.motions, self.sleep_state, self.envs])
            self._search_contacts(woken=1)
        self._sum(pairs.contact_count, pairs.contact_start, CONTACTS, contacts.key.shape[0])
        size, inputs = self.pools.sizes["pairs"], [*self.moving, self.envs, pairs, self.pools.near, self.pools.history]
        with self.parts.shared():
            self.share(build_contacts.build_contacts, size, inputs, [contacts], lanes=teams.BUILD_LANES)

    @stage
    def wake_changed_islands(self) -> None:
        """Sleeping: wake the islands that were changed by the user, or whose support was changed."""
        self.per_body(sleep.find_changed, [self.model.bodies, self.state], [self.motions, self.sleep_state, self.envs])
        self.wake_disturbed_islands()

    def wake_disturbed_islands(self) -> None:
        """Wake the islands of the bodies marked as disturbed, and those in contact with them."""
        self.per_body(sleep.wake_neighbors, [self.pools.history], [self.sleep_state])
        joints = self.model.joints
        inputs = [joints.body_a, joints.body_b, self.motions]
        self.launch(sleep.wake_joined, self.model.layout.sizes["joints"], inputs, [self.sleep_state])
        self.per_body(sleep.wake_islands, [self.model.bodies], [self.motions, self.sleep_state, self.envs])

    @stage
    def build_graph(self) -> None:
        """Contact graph: supports, islands and how each is solved, levels, and colouring for the solving order."""
        bodies, constraints, graph = self.model.bodies, self.pools.constraints, self.pools.graph
        most = self.pools.sizes["pairs"]
        self.share(support.start_graph, most, [self.envs, self.pools.pairs], [constraints, graph])
        found = [bodies, self.motions, self.pools.contacts, constraints]
        self.share(support.find_support, most, found, [graph])
        self.per_env(support.compare_graph, [], [graph])
        self.per_body(islands.start_islands, [bodies], [graph])
        self.share(islands.join_islands, most, [bodies, constraints], [graph])
        self.joints.join_islands()
        voting = [self.dt, self.model.shapes, bodies, self.envs, self.motions]
        self.per_body(islands.vote, voting, [graph, self.state])
        self.per_body(islands.choose_solver, [self.dt, bodies, self.envs], [graph])
        if self.crowded:
            self.heaps.list_pairs()
        self.per_team(support.find_structure, [bodies, constraints], [graph])
        self.per_team(coloring.order_constraints, [bodies, constraints], [graph, self.pools.order])
        self.joints.start()

    @stage
    def integrate_velocities(self, after_impacts: bool) -> None:
        """Velocity update: add the acceleration of the step, in environments whose stage order has it here."""
        model = self.model
        inputs = [self.dt, int(after_impacts), model.bodies, self.envs, model.fields, self.state]
        self.per_body(predict.integrate_velocities, inputs, [self.motions])

    @stage
    def solve_impacts(self) -> None:
        """Restitution: solve impacts."""
        self.joints.solve_impacts(restitution.solve_impacts)
        if self.crowded:
            self.heaps.solve_impacts()

    @stage
    def solve_contacts(self) -> None:
        """Contact solver: sweeps and shock propagation, with direct solutions of mechanisms; rounds for heaps."""
        if self.joints.present:
            self.joints.solve_contacts()
        else:
            self.solve_parts(SolverPart.ALL, range(self.repetitions))
        if self.crowded:
            self.heaps.solve()

    def solve_parts(self, parts: SolverPart, repetitions: range = range(1)) -> None:
        """Launch some parts of the contact solver; shock propagation with the given repetitions."""
        self._color_by_color(contact_solver.solve_contacts, [int(parts), repetitions.start, repetitions.stop, self.dt])

    @stage
    def push_out(self) -> None:
        """Push-out: separate remaining overlaps without adding velocity."""
        model, pools = self.model, self.pools
        inputs = [model.shapes, model.bodies, self.state, self.envs, pools.pairs]
        changed = [self.motions, pools.graph, pools.contacts]
        self.share(push_out.find_overlaps, pools.sizes["contacts"], inputs, changed, before=[self.dt])
        self._color_by_color(push_out.push_apart)
        if self.crowded:
            self.heaps.push_out()
        self.joints.push_out()

    @stage
    def detect_continuous_collisions(self) -> None:
        """Continuous collision detection: find how far fast bodies can move before they penetrate others."""

        def find_impacts() -> None:
            self._trace_fast_pairs()
            self.open_iteration(is_first=0)

        self.open_iteration(is_first=1)
        wp.capture_while(self.pools.suspects.again, find_impacts)
        self.joints.close_stopped()

    @stage
    def integrate_positions(self) -> None:
        """Position update, with checks for non-finite states before it and for bodies out of bounds after it."""
        bodies = self.model.bodies
        self.per_body(integrate.find_non_finite, [bodies, self.motions], [self.envs])
        self.per_body(
            integrate.integrate_positions, [self.dt, bodies, self.motions, self.pools.graph, self.envs], [self.state]
        )
        if self.bounded:
            self.per_body(integrate.keep_inside, [bodies, self.motions], [self.state, self.envs])
        self.per_env(integrate.close_step, [self.pools.graph], [self.envs])
        self.joints.end()

    @stage
    def update_sleep(self) -> None:
        """Sleeping: put islands to sleep that have been at rest for long enough."""
        graph, bodies, pairs = self.pools.graph, self.model.bodies, self.pools.pairs
        self.per_body(sleep.track_motion, [self.model.shapes, bodies, self.state, self.motions], [self.sleep_state])
        inputs = [self.dt, self.model.shapes, bodies, self.envs, self.motions, graph, self.state]
        self.per_body(sleep.test_bodies_for_sleep, inputs, [self.sleep_state])
        inputs = [pairs, self.motions, bodies, graph]
        self.launch(sleep.test_support_for_sleep, self.pools.sizes["pairs"], inputs, [self.sleep_state])
        self.joints.support()
        self.per_body(sleep.put_islands_to_sleep, [self.motions, graph], [self.state, self.sleep_state])

    @stage
    def record_watches(self) -> None:
        """Watches: record contact impulses, contacts, overlaps and motion of the watched bodies."""
        model, pools = self.model, self.pools
        inputs = [self.envs, model.bodies, pools.pairs, pools.contacts, pools.history, self.motions]
        for summing in (0, 1):
            self.share(watch.watch_pairs, pools.sizes["pairs"], inputs, [self.watches], before=[summing])
        self.per_body(watch.watch_bodies, [AT_REST, model.bodies, self.motions, self.state, self.envs], [self.watches])
        self.per_env(watch.close_watches, [self.envs], [self.watches])

    @stage
    def store_history(self) -> None:
        """History: store the contacts of this step and of sleeping bodies, for warm starting in the next step."""
        pairs, contacts, history = self.pools.pairs, self.pools.contacts, self.pools.history
        rows = max(history.pair_start.shape[0], history.contact_start.shape[0], self.pools.sizes["contacts"])
        if self.sleeping:
            self.share(sleep.count_history, self.pools.sizes["pairs"], [history, self.motions], [pairs])
            self._sum(pairs.contact_count, self.kept.contact_start, CONTACTS, contacts.key.shape[0])
            self.share(
                sleep.merge_history, self.pools.sizes["pairs"], [pairs, contacts, history, self.motions], [self.kept]
            )
        inputs, stored = [contacts, pairs, self.pools.constraints], [history, self.pools.graph]
        self.share(build_contacts.store_lists, rows, inputs, stored, before=[int(not self.sleeping)])
        if self.sleeping:
            wp.copy(history.contact_start, self.kept.contact_start)
            self.share(sleep.replace_history, self.pools.sizes["contacts"], [self.kept], [history])
        self.launch(capacity.close_row, 1, [self.pools.wanted], [self.pools.wanted_row])

    def levels(self) -> np.ndarray:
        """Level of each body in the contact graph of the last step, (bodies,).

        The step needs no levels of islands that are solved in rounds. Those of their environments are found here, in
        arrays of their own.
        """
        graph, level = self.pools.graph, self.pools.graph.level.numpy()
        in_rounds = graph.solver.numpy() == IslandSolver.ROUNDS
        if not in_rounds.any():
            return level
        env = self.model.bodies.env.numpy()
        chosen = np.bincount(env[in_rounds], minlength=self.num_envs) > 0
        found = declare.allocate(schema.Graph, self.pools.sizes, self.device)
        found.supports = graph.supports
        found.swept.assign(chosen.astype(np.int32))
        self.per_team(support.find_structure, [self.model.bodies, self.pools.constraints], [found])
        return np.where(chosen[env] & (self.sleep_state.asleep.numpy() == 0), found.level.numpy(), level)

    def deepest_overlap(self, deepest: Any) -> None:
        """Find the deepest overlap of each environment in the current state: an array (envs, 1) of floats [m].

        It is not part of the recorded step; `load_kernels` must have been called for `OVERLAP`.
        """
        deepest.zero_()
        self.move_ground()
        self.predict(0.0)
        self.find_pairs()
        lanes = teams.MEASURING_LANES if self.device.is_cuda else 1
        inputs = [lanes, self.model.shapes, self.model.bodies, self.state, self.pools.pairs]
        self.launch(overlap.deepest_overlap, lanes * self.pools.sizes["pairs"], inputs, [deepest])

    def _color_by_color(self, kernel: Any, before: Sequence = ()) -> None:
        """Launch a solver kernel that processes the constraints colour by colour."""
        pools = self.pools
        self.per_team(kernel, [pools.order], [pools.graph, self.motions, pools.contacts], before)

    def per_body(self, kernel: Any, inputs: list, outputs: list) -> None:
        """Launch a kernel with a thread for each body."""
        self.launch(kernel, self.rows, inputs, outputs)

    def share(
        self, kernel: Any, size: int, inputs: list, outputs: list, before: Sequence = (), lanes: int | None = None
    ) -> None:
        """Launch a kernel whose threads, or teams of some lanes, share `size` rows; in a shared part with other cores.

        Elsewhere a single thread of a CPU takes all rows, as a launch is serial there.
        """
        cuda = self.device.is_cuda
        width = lanes if lanes and cuda else 1
        count = min(size, teams.most_lanes(self.device) // width) if cuda else 1
        sharing: Any = count
        if self.parts.in_shared_part:
            sharing = self.parts.sharing(count)
            count = sharing.count
        own = [sharing, width] if lanes else [sharing]
        self.launch(kernel, count * width, [*before, *own, *inputs], outputs)

    def per_env(self, kernel: Any, inputs: list, outputs: list) -> None:
        """Launch a kernel with a thread for each environment."""
        self.launch(kernel, self.num_envs, inputs, outputs)

    def per_team(self, kernel: Any, inputs: list, outputs: list, before: Sequence = ()) -> None:
        """Launch a kernel in which a team processes each environment."""
        inputs = [*before, self.lanes, self.envs, *inputs]
        self.launch(kernel, self.num_envs * self.lanes, inputs, outputs)

    def _sum(self, count: wp.array, start: wp.array, which: int, size: int) -> None:
        """Exclusive sums of counts; a list that exceeds its capacity is emptied and its length recorded."""
        wp.utils.array_scan(count, start, inclusive=False)
        wanted_row, wanted, rows = self.pools.wanted_row, self.pools.wanted, start.shape[0]
        self.launch(capacity.note_wanted, rows, [which, start, wanted_row], [wanted])
        self.launch(capacity.empty_if_over, rows, [which, size, wanted_row, wanted], [start])

    def open_iteration(self, is_first: int) -> None:
        """List the pairs of an iteration: fast ones in the first one, then those of bodies that were hit."""
        pairs, suspects = self.pools.pairs, self.pools.suspects
        self.per_body(ccd.open_iteration, [is_first, self.dt, pairs], [self.motions, suspects])
        self.joints.join_courses()
        self.share(ccd.list_fast_pairs, self.pools.sizes["pairs"], [*self.moving, self.envs], [suspects, pairs])

    def _trace_fast_pairs(self) -> None:
        """The times of impact of the listed pairs, and the motion of bodies after their first impact."""
        model, pools, pairs, suspects = self.model, self.pools, self.pools.pairs, self.pools.suspects
        size = pools.sizes["pairs"]
        lanes = teams.ADVANCE_LANES_IN_CROWDS if self.crowded else teams.ADVANCE_LANES
        inputs = [self.dt, model.shapes, model.bodies, self.state, pairs]
        self.share(ccd.advance_solids, size, inputs, [suspects, self.motions], lanes=lanes)
        if not model.layout.has_only_solids:
            wp.capture_if(suspects.sampled, self._trace_samples)
        inputs = [self.dt, model.shapes, model.bodies, self.state, self.envs, pairs, suspects]
        self.per_body(ccd.change_courses, inputs, [self.motions])
        self.joints.share_impacts()

    def _trace_samples(self) -> None:
        """The times of impact of listed pairs that are not both convex solids, where there are any."""
        model, pools, pairs, suspects = self.model, self.pools, self.pools.pairs, self.pools.suspects
        size, samples, before = pools.sizes["pairs"], pools.sizes["near_samples"], [NEAR_SAMPLES]
        self.share(ccd.list_reached, 2 * size, [*self.moving, pairs], [suspects])
        self.share(ccd.list_clusters, 2 * size, [*self.moving, pairs], [suspects], lanes=teams.TRACE_LANES)
        inputs, outputs = [*self.moving, pairs, pools.wanted_row], [suspects, pools.wanted]
        self.share(ccd.list_suspects, samples, inputs, outputs, before=before, lanes=teams.LOOK_LANES)
        inputs = [self.dt, model.shapes, model.bodies, self.state, pairs, pools.wanted_row]
        self.share(ccd.trace_suspects, samples, inputs, [suspects, self.motions, pools.wanted], before=before)

    def _search_contacts(self, woken: int) -> None:
        """One search of the narrow phase: of the awake pairs, or of those that have just been woken."""
        pools, pairs, near = self.pools, self.pools.pairs, self.pools.near
        searched = [*self.moving, self.envs]
        pairs.candidate_count.zero_()
        if woken:  # the samples of the second search follow those of the first
            wp.copy(near.begin, near.count)
        size, samples, listing = pools.sizes["pairs"], pools.sizes["near_samples"], self.listing_lanes
        with self.parts.shared():
            self.share(narrowphase.keep_contacts, size, [*searched, pools.history], [pairs, near], before=[woken])
            self.share(narrowphase.list_near_samples, size, searched, [pairs, near], lanes=listing)
            inputs, outputs = [*self.moving, pairs, pools.wanted_row], [near, pools.wanted]
            self.share(touches.touch_near_samples, samples, inputs, outputs, before=[woken, NEAR_SAMPLES])
            chosen = pair_contacts.choose_contacts
            self.share(chosen, size, [*searched, near, pools.history], [pairs], lanes=self.choosing_lanes)

    def _search_pairs(self, write: int) -> None:
        """One search of the broad phase: count the pairs, or write them."""
        model, grid = self.model, self.grid
        inputs = [grid.room, grid.cells, model.shapes, model.bodies, self.motions, self.envs, self.pools.history]
        self.share(
            broadphase.list_pairs_of_bodies, self.rows, inputs, [self.pools.pairs], before=[write], lanes=grid.lanes
        )

    def launch(self, kernel: Any, dim: int, inputs: list, outputs: list) -> None:
        """Launch a kernel as it was compiled for this step."""
        block = loading.block_of(kernel.module.name, self.lanes)
        kernel = loading.kernel_for(kernel, self.device, self.lanes)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=block, device=self.device)
