"""The step as a sequence of kernel launches, recorded once and replayed."""

import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any, NamedTuple

import warp as wp

from warp_rigid.engine.cores import usable_cores
from warp_rigid.engine.model import Model
from warp_rigid.engine.pools import Pools
from warp_rigid.kernels import schema
from warp_rigid.kernels.collide import bake, broadphase, ccd, narrowphase, overlap
from warp_rigid.kernels.common import capacity, team
from warp_rigid.kernels.constraints import contact
from warp_rigid.kernels.graph import coloring, support
from warp_rigid.kernels.solve import gauss_seidel, line_search, push_out, restitution, shock
from warp_rigid.kernels.update import ground_motion, integrate, predict, sleep

TRY_ALL_UP_TO = 256
"""Up to so many small bodies an environment, trying all pairs beats the hash grid."""

BUCKETS_A_BODY = 2
"""Buckets of the hash grid for each small body of an environment, at least: so that cells seldom share one."""

PAIRS, CONTACTS = 0, 1

WARP = 32

RESIDENT_WARPS = 132 * 16
"""About as many warps as a large GPU holds at the same time."""

MOST_BODIES_OF_A_WARP = 128
"""Beyond so many bodies an environment, a whole block solves it."""

SEARCH_LANES, BUILD_LANES = 32, 4
"""Lanes of a GPU that look for the contacts of one pair together, and that make its records."""

MOST_LANES = 132 * 2048
"""Lanes that share the pairs on a GPU: as many as can be at work at the same time."""

TEAM_MODULES = (restitution, shock, gauss_seidel, support, coloring, line_search, push_out)
"""Their kernels solve an environment by a team; the longest first."""

STEP = (narrowphase, ccd, *TEAM_MODULES, integrate, predict, broadphase, contact, capacity)
"""Modules of kernels that every step needs, those that take longest to compile first."""

GRIDS, OVERLAP, SLEEP, GROUND = (bake,), (overlap,), (sleep,), (ground_motion,)
"""Those of distance grids, of `deepest_overlap`, of bodies that may sleep, and of ground that moves."""

EVERYTHING = (narrowphase, ccd, *OVERLAP, *GRIDS, *STEP[2:], *SLEEP, *GROUND)


def load_kernels(
    device: Any,
    modules: Sequence[Any],
    lanes: Sequence[int] = (1,),
    on_module: Callable[[int, int], None] | None = None,
) -> None:
    """Compile kernels, or take them from Warp's cache, several modules at a time, in their order.

    A graph cannot hold a compilation, so whatever is recorded must have been loaded. What is needed rarely is loaded
    when it is needed.

    Args:
        device: the Warp device.
        modules: those of `warp_rigid.kernels` that are needed.
        lanes: sizes of the teams that will solve environments.
        on_module: called with how many modules are ready and how many there are, whenever one more is.
    """
    teams = sorted({team.block_of(size) for size in lanes}) if device.is_cuda else [1]
    others = [team.BLOCK if device.is_cuda else 1]
    jobs = [(module, block) for module in modules for block in (teams if module in TEAM_MODULES else others)]
    with ThreadPoolExecutor(usable_cores()) as pool:
        loaded = [pool.submit(wp.force_load, device, [wp.get_module(module.__name__)], block) for module, block in jobs]
        for ready, done in enumerate(as_completed(loaded), start=1):
            done.result()
            if on_module is not None:
                on_module(ready, len(jobs))


class Teams(NamedTuple):
    """Lanes that do one environment together: where all pairs are looked through, and in one colour."""

    graph: int
    color: int


BODIES_OF_A_BLOCK = Teams(graph=64, color=256)
"""So many bodies give the lanes of a block something to do. More blocks wait longer for each other."""


def team_sizes(device: Any, num_envs: int, bodies_per_env: int) -> Teams:
    """How many lanes do one environment together.

    A warp each, as long as all fit on the GPU at once; then smaller teams, which share a warp and get in each other's
    way a little, and no smaller than a small environment can use. Large environments get a block, or as many blocks as
    they have use for while every block has a multiprocessor of its own.
    """
    if not device.is_cuda:
        return Teams(1, 1)
    if bodies_per_env > MOST_BODIES_OF_A_WARP:
        return Teams(*(_blocks(device, num_envs, bodies_per_env, share) * team.BLOCK for share in BODIES_OF_A_BLOCK))
    lanes = WARP
    while lanes > 8 and num_envs * lanes > RESIDENT_WARPS * WARP and bodies_per_env < 2 * lanes:
        lanes //= 2
    return Teams(lanes, lanes)


def _blocks(device: Any, num_envs: int, bodies_per_env: int, share: int) -> int:
    """Blocks for an environment if each has enough to do with so many bodies."""
    blocks = 1
    while 2 * blocks * num_envs <= device.sm_count and bodies_per_env > blocks * share:
        blocks *= 2
    return blocks


STAGES: list[str] = []
"""Stages of a step by name, in the order of their definition."""


def stage(method: Callable[..., None]) -> Callable[..., None]:
    """Mark a method of `Stages` as a stage of the step, which `Stages.on_stage` is notified of."""
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
    """Do nothing: a step that is not profiled."""


class Stages:
    """The stages of a step over one set of arrays; a change of the pools needs a new object.

    Args:
        model: what is constant.
        state: what a step changes.
        rest: who sleeps.
        envs: settings of the environments.
        pools: pairs, contacts and graph.
        dt: time step [s].
        repetitions: largest number of shock iterations in any environment.
        sleeping: whether bodies may fall asleep in any environment.
    """

    def __init__(
        self,
        model: Model,
        state: Any,
        sleep_state: Any,
        envs: Any,
        pools: Pools,
        dt: float,
        repetitions: int,
        sleeping: bool,
    ) -> None:
        """Record the step; `load_kernels` has been called for `STEP`."""
        self.model, self.state, self.sleep_state, self.envs, self.pools = model, state, sleep_state, envs, pools
        self.dt, self.repetitions, self.sleeping = dt, repetitions, sleeping
        self.on_stage: Callable[[str | None], None] = ignore_stage
        self.current_stage: str | None = None
        device: Any = pools.wanted.device
        self.device = device
        self.num_envs = model.num_envs
        self.num_bodies = len(model.scene.bodies)
        self.rows = self.num_envs * self.num_bodies
        self.teams = team_sizes(self.device, self.num_envs, self.num_bodies)
        self.motions = schema.allocate(schema.Motions, pools.sizes, self.device)
        self.kept: Any = schema.allocate(schema.History, pools.sizes, self.device) if sleeping else None
        self.cells: Any = self._make_cells()
        load_kernels(device, [*(SLEEP if sleeping else ()), *(GROUND if model.surface_vertices else ())])
        with wp.ScopedCapture(self.device, force_module_load=False) as capture:
            self.step()
        self._graph = capture.graph

    def replay(self) -> None:
        """Do one step."""
        wp.capture_launch(self._graph)

    def step(self) -> None:
        """One step of the method (Guendelman et al. 2003, section 4), with each stage's remedies."""
        self.move_ground()
        self.predict(self.dt)
        if self.sleeping:
            self.wake_changed_islands()
        self.find_pairs()
        self.find_contacts()
        self.build_graph()
        self.integrate_velocities(before_collisions=True)
        self.set_surface_velocity(before_step=True)
        self.solve_impacts()
        self.integrate_velocities(before_collisions=False)
        self.set_surface_velocity(before_step=False)
        self.solve_contacts()
        self.push_out()
        self.detect_continuous_collisions()
        self.integrate_positions()
        if self.sleeping:
            self.update_sleep()
        self.store_history()

    @stage
    def move_ground(self) -> None:
        """Bring ground that moves to where it is now."""
        count = self.model.surface_vertices
        if count:
            wp.launch(
                ground_motion.move_ground,
                dim=count,
                inputs=[self.dt, self.model.surface_node, self.envs, self.model.surfaces],
                outputs=[self.model.shapes],
                device=self.device,
            )

    @stage
    def set_surface_velocity(self, before_step: bool) -> None:
        """Tell the contacts how fast ground moves, before this step or over it."""
        if self.model.surface_vertices:
            model, records = self.model, self.pools.contacts
            inputs = [
                int(before_step),
                self.model.surface_node,
                self.num_bodies,
                model.shapes,
                model.bodies,
                self.state,
            ]
            wp.launch(
                ground_motion.set_surface_velocity,
                dim=records.key.shape[0],
                inputs=[*inputs, self.envs, model.surfaces, self.pools.pairs],
                outputs=[records],
                device=self.device,
            )

    @stage
    def predict(self, dt: float) -> None:
        """Derive world quantities and swept boxes."""
        self._per_body(
            predict.derive_motion,
            [
                self.num_bodies,
                self.model.field_count,
                self.model.bodies,
                self.state,
                self.sleep_state,
                self.envs,
                self.model.fields,
            ],
            [self.motions],
        )
        self._per_body(predict.sweep_boxes, [dt, self.model.shapes, self.model.bodies, self.state], [self.motions])
        if self.model.surface_vertices:
            self._per_body(
                ground_motion.drive_ground,
                [self.num_bodies, self.model.shapes, self.model.bodies, self.envs],
                [self.motions],
            )

    @stage
    def find_pairs(self) -> None:
        """Count the overlapping pairs, sum, and write them."""
        pairs = self.pools.pairs
        if self.buckets:
            self._fill_cells()
        self._search_pairs(write=0)
        self._sum(pairs.count, pairs.start, PAIRS, pairs.body_a.shape[0])
        self._search_pairs(write=1)

    @stage
    def find_contacts(self) -> None:
        """Find touching samples, thin them, and make contact records."""
        pairs, records = self.pools.pairs, self.pools.contacts
        bodies_of_pair = [self.model.shapes, self.model.bodies, self.state, self.motions, self.envs]
        pairs.contact_count.zero_()
        self._search_contacts(woken=0)
        if self.sleeping:
            self._per_pair(sleep.wake_touched, [pairs], [self.sleep_state])
            self._per_body(sleep.wake_islands, [self.num_bodies], [self.motions, self.sleep_state, self.envs])
            self._search_contacts(woken=1)
        self._sum(pairs.contact_count, pairs.contact_start, CONTACTS, records.key.shape[0])
        inputs = [self.dt, self.model.combine_rules, *bodies_of_pair, pairs, self.pools.history]
        self._share_pairs(contact.build_contacts, BUILD_LANES, inputs, [records])

    @stage
    def wake_changed_islands(self) -> None:
        """Wake the islands that were changed from outside, or whose support was."""
        self._per_body(sleep.find_changed, [self.num_bodies, self.state], [self.motions, self.sleep_state, self.envs])
        self.wake_disturbed_islands()

    def wake_disturbed_islands(self) -> None:
        """Wake the islands of the bodies that are marked as disturbed, and those that lie on them."""
        self._per_body(sleep.wake_neighbors, [self.pools.history], [self.sleep_state])
        self._per_body(sleep.wake_islands, [self.num_bodies], [self.motions, self.sleep_state, self.envs])

    @stage
    def build_graph(self) -> None:
        """Who rests on whom, levels, islands, and the order of solving."""
        bodies, pairs, graph = self.model.bodies, self.pools.pairs, self.pools.graph
        lanes = self.teams.graph
        own = [lanes, self.num_bodies, bodies]
        touching = [self.motions, pairs, self.pools.contacts, self.pools.history]
        self._per_team(lanes, support.find_support, [*own, *touching], [graph])
        self._per_team(lanes, support.find_levels, [*own, pairs], [graph])
        self._per_team(lanes, support.find_depths, [*own, pairs], [graph])
        self._per_team(lanes, support.find_islands, [*own, pairs], [graph])
        self._per_team(lanes, coloring.color_pairs, [*own, pairs], [graph])
        self._per_team(lanes, coloring.group_pairs, [lanes, self.num_bodies, pairs], [graph, self.pools.order])

    @stage
    def integrate_velocities(self, before_collisions: bool) -> None:
        """Velocity update, in the environments whose stage order has it here."""
        self._per_body(
            predict.integrate_velocities,
            [self.dt, 0 if before_collisions else 1, self.num_bodies, self.envs],
            [self.motions],
        )

    @stage
    def solve_impacts(self) -> None:
        """Impacts with restitution."""
        self._color_by_color(restitution.collide, [self.dt])

    @stage
    def solve_contacts(self) -> None:
        """Contact impulses: warm start, sweeps, shock propagation, sweeps."""
        self._color_by_color(gauss_seidel.warm_start)
        self.sweep_contacts(after_shock=0)
        for repetition in range(self.repetitions):
            self.propagate_shock(repetition)
        self.sweep_contacts(after_shock=1)

    def sweep_contacts(self, after_shock: int) -> None:
        """Sweeps over all contacts."""
        self._color_by_color(gauss_seidel.sweep_contacts, [after_shock], [self.state])

    @stage
    def propagate_shock(self, repetition: int) -> None:
        """Shock propagation, and the line search that keeps it from gaining energy."""
        self._color_by_color(line_search.store_start, [self.state])
        self._color_by_color(shock.propagate, [repetition])
        self._color_by_color(line_search.sum_energy)
        self._color_by_color(line_search.accept, [repetition], [self.state])

    @stage
    def push_out(self) -> None:
        """Separate remaining overlaps without adding velocity."""
        model, pools = self.model, self.pools
        self._per_team(
            self.teams.color,
            push_out.find_overlaps,
            [self.dt, self.teams.color, self.num_bodies, model.shapes, model.bodies, self.envs, pools.pairs],
            [self.motions, pools.graph, pools.contacts],
        )
        self._color_by_color(push_out.push_apart)

    @stage
    def detect_continuous_collisions(self) -> None:
        """Find how far fast bodies can move before they would pass into others."""
        self._per_body(ccd.limit_travel, [self.dt], [self.motions])
        self._limit_motion(ccd.limit_motion, [0])
        self._per_body(ccd.commit_time_of_impact, [], [self.motions])
        self._limit_motion(ccd.limit_motion, [1])

    @stage
    def integrate_positions(self) -> None:
        """Position update, after a look for non-finite states, and a look for bodies out of bounds after it."""
        scene, bodies = self.model.scene, self.model.bodies
        self._per_body(integrate.find_non_finite, [self.num_bodies, self.motions], [self.envs])
        self._per_body(
            integrate.integrate_positions, [self.dt, self.num_bodies, bodies, self.motions, self.envs], [self.state]
        )
        if scene.bounds is not None:
            lower, upper = (wp.vec3(corner) for corner in scene.bounds)
            remove = int(scene.out_of_bounds == "remove")
            self._per_body(
                integrate.keep_inside,
                [self.num_bodies, lower, upper, remove, bodies, self.motions],
                [self.state, self.envs],
            )
        self._per_env(integrate.close_step, [self.num_bodies], [self.envs])

    @stage
    def update_sleep(self) -> None:
        """Put the islands to sleep that have kept still for long enough."""
        graph, bodies, pairs = self.pools.graph, self.model.bodies, self.pools.pairs
        self._per_body(sleep.track_motion, [self.model.shapes, bodies, self.state, self.motions], [self.sleep_state])
        self._per_body(
            sleep.test_bodies_for_sleep,
            [self.dt, self.num_bodies, self.envs, self.motions, graph, self.state],
            [self.sleep_state],
        )
        self._per_pair(sleep.test_support_for_sleep, [pairs, self.motions, bodies, graph], [self.sleep_state])
        self._per_body(sleep.put_islands_to_sleep, [self.motions, graph], [self.state, self.sleep_state])

    @stage
    def store_history(self) -> None:
        """Keep this step's contacts for the next one's warm start, and those on which sleepers lie."""
        pairs, records, history = self.pools.pairs, self.pools.contacts, self.pools.history
        rows = max(history.pair_start.shape[0], history.contact_start.shape[0])
        if self.sleeping:
            self._shared(sleep.count_history, self.pools.sizes["pairs"], [], [history, self.motions], [pairs])
            self._sum(pairs.contact_count, self.kept.contact_start, CONTACTS, records.key.shape[0])
            self._shared(
                sleep.merge_history, self.pools.sizes["pairs"], [], [pairs, records, history, self.motions], [self.kept]
            )
        self._shared(contact.store_pairs, rows, [], [pairs], [history, self.pools.graph])
        if self.sleeping:
            wp.copy(history.contact_start, self.kept.contact_start)
            self._shared(sleep.replace_history, self.pools.sizes["contacts"], [], [self.kept], [history])
        else:
            self._shared(contact.store_impulses, self.pools.sizes["contacts"], [], [records, pairs], [history])
        wp.launch(capacity.close_turn, dim=1, inputs=[self.pools.wanted], outputs=[self.pools.turn], device=self.device)

    def deepest_overlap(self, deepest: Any) -> None:
        """Find the deepest overlap of each environment in the present state: an array (envs, 1) of floats [m].

        It is no part of the recorded step: `load_kernels` must have been called for `OVERLAP`.
        """
        deepest.zero_()
        self.move_ground()
        self.predict(0.0)
        self.find_pairs()
        self._per_pair(
            overlap.deepest_overlap,
            [self.num_bodies, self.model.shapes, self.model.bodies, self.state, self.pools.pairs],
            [deepest],
        )

    def _color_by_color(self, kernel: Any, before: Sequence = (), after: Sequence = ()) -> None:
        """Launch a kernel of the solver that goes through the touching pairs colour by colour."""
        pools, lanes = self.pools, self.teams.color
        inputs = [*before, lanes, self.num_bodies, self.envs, pools.order]
        self._per_team(lanes, kernel, inputs, [pools.graph, self.motions, pools.contacts, *after])

    def _per_body(self, kernel: Any, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=self.rows, inputs=inputs, outputs=outputs, device=self.device)

    def _per_pair(self, kernel: Any, inputs: list, outputs: list) -> None:
        dim = self.pools.pairs.body_a.shape[0]
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _share_pairs(self, kernel: Any, lanes: int, inputs: list, outputs: list) -> None:
        """Launch a kernel whose teams, of so many lanes on a GPU, share the pairs."""
        teams = min(self.pools.sizes["pairs"], MOST_LANES // lanes) if self.device.is_cuda else 1
        lanes = lanes if self.device.is_cuda else 1
        inputs = [teams, lanes, *inputs]
        wp.launch(kernel, dim=teams * lanes, inputs=inputs, outputs=outputs, device=self.device)

    def _per_env(self, kernel: Any, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=self.num_envs, inputs=inputs, outputs=outputs, device=self.device)

    def _per_team(self, lanes: int, kernel: Any, inputs: list, outputs: Sequence) -> None:
        dim, block = self.num_envs * lanes, team.block_of(lanes)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=block, device=self.device)

    def _sum(self, count: wp.array, start: wp.array, which: int, size: int) -> None:
        """Exclusive sums of counts; a list that does not fit is emptied and its length noted."""
        wp.utils.array_scan(count, start, inclusive=False)
        wp.launch(
            capacity.note_wanted,
            dim=start.shape[0],
            inputs=[which, start, self.pools.turn],
            outputs=[self.pools.wanted],
            device=self.device,
        )
        wp.launch(
            capacity.empty_if_over,
            dim=start.shape[0],
            inputs=[which, size, self.pools.turn, self.pools.wanted],
            outputs=[start],
            device=self.device,
        )

    def _limit_motion(self, kernel: Any, before: list) -> None:
        """One round over the pairs of the swept detection."""
        inputs = [self.dt, self.model.shapes, self.model.bodies, self.state, self.pools.pairs]
        self._shared(kernel, self.pools.sizes["pairs"], before, inputs, [self.motions])

    def _search_contacts(self, woken: int) -> None:
        """One round of the narrow phase: the pairs at hand, or the dormant ones that have just woken."""
        pairs = self.pools.pairs
        bodies_of_pair = [self.model.shapes, self.model.bodies, self.state, self.motions, self.envs]
        pairs.candidate_count.zero_()
        inputs = [self.dt, *bodies_of_pair, self.pools.history]
        self._shared(narrowphase.keep_contacts, self.pools.sizes["pairs"], [woken], inputs, [pairs])
        inputs = [self.dt, *bodies_of_pair]
        self._share_pairs(narrowphase.search_contacts, SEARCH_LANES, inputs, [pairs])

    def _search_pairs(self, write: int) -> None:
        """One round of the broad phase: count the pairs or write them."""
        model = self.model
        kernel, own = broadphase.pairs_by_trying_all, []
        if self.buckets:
            kernel, own = broadphase.pairs_by_grid, [self.buckets, model.grid_radius]
        common = [self.cells, model.bodies, self.motions, self.envs, self.pools.history]
        self._shared(kernel, self.rows, [write], [*own, *common], [self.pools.pairs])

    def _shared(self, kernel: Any, size: int, before: list, inputs: list, outputs: list) -> None:
        """Launch a kernel whose threads share `size` rows: one thread on the CPU, where threads run in turn anyway."""
        threads = size if self.device.is_cuda else 1
        wp.launch(kernel, dim=threads, inputs=[*before, threads, *inputs], outputs=outputs, device=self.device)

    def _make_cells(self) -> Any:
        """What the broad phase works on: a hash grid for environments of many bodies, none for small ones."""
        small = self.model.small.shape[0]
        self.buckets = 1 << math.ceil(math.log2(BUCKETS_A_BODY * small)) if small > TRY_ALL_UP_TO else 0
        points = self.num_envs * small if self.buckets else 0
        sizes = {"small": 0, "oversized": 0, "points": points, "buckets": self.num_envs * self.buckets}
        cells = schema.allocate(schema.Cells, {**sizes, "envs": self.num_envs}, self.device)
        cells.small, cells.oversized = self.model.small, self.model.oversized
        return cells

    def _fill_cells(self) -> None:
        """Sort the small bodies into the hash grid; those of a bucket keep their order."""
        cells, device = self.cells, self.device
        count = self.num_envs * self.model.small.shape[0]
        cells.reach.zero_()
        inputs = [self.num_bodies, self.buckets, self.model.grid_radius, self.motions]
        wp.launch(broadphase.choose_buckets, dim=count, inputs=inputs, outputs=[cells], device=device)
        wp.utils.radix_sort_pairs(cells.key, cells.member, count, end_bit=(self.num_envs * self.buckets).bit_length())
        wp.launch(broadphase.find_bucket_starts, dim=count + 1, inputs=[count], outputs=[cells], device=device)
