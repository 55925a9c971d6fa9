"""Rounds: the launches of the kernels that solve the islands of large environments."""

from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_rigid.engine import teams
from warp_rigid.engine.step_parts import StepParts
from warp_rigid.kernels.common import team
from warp_rigid.kernels.solve import impact_rounds, push_rounds, rest, rounds
from warp_rigid.kernels.solve.round_sharing import ROUNDS_OF_A_GROUP


class HeapStages:
    """What the stages of a step launch for islands that are solved in rounds, in environments of many bodies only.

    Args:
        stages: the stages of the step.
    """

    def __init__(self, stages: Any) -> None:
        """Look up the arrays."""
        self.model, self.state, self.envs = stages.model, stages.state, stages.envs
        self.pools, self.motions = stages.pools, stages.motions
        self.dt, self.device = stages.dt, stages.device
        self._step = stages
        self.parts: StepParts = stages.parts
        self.rows, self.most_pairs = stages.rows, stages.pools.sizes["pairs"]

    def list_pairs(self) -> None:
        """List the pairs that are solved in rounds, and give them slots."""
        pools, solved = self.pools, self.pools.rounds
        self._step.share(rounds.open_rounds, self.rows, [], [solved], before=[0])
        self._step.share(rounds.open_slots, self.rows, [], [pools.slots])
        found = [self.model.bodies, self.envs, self.motions, pools.constraints, pools.graph]
        self._step.share(rounds.list_pairs, self.most_pairs, found, [solved, pools.slots], before=[self.dt])
        self._step.share(rounds.assign_slots, self.rows, [], [pools.slots])
        self._per_round_pair(rounds.place_pairs, solved, [], [pools.slots, pools.contacts])

    def solve_impacts(self) -> None:
        """Rounds of impacts, as many as the setting allows, until there are none."""
        pools, hit = self.pools, self.pools.selected
        changed = [self.motions, pools.contacts, pools.slots]

        def find(done: int) -> None:
            self._step.share(rounds.open_rounds, self.rows, [], [hit], before=[done])
            inputs = [self.envs, pools.rounds, hit]
            self._step.share(impact_rounds.find_impacts, self.most_pairs, inputs, changed, before=[self.dt])

        def solve() -> None:
            counted = [*changed, pools.graph.impact_rounds]
            self._per_round_pair(impact_rounds.impact_round, hit, [self.envs], counted, [self.dt])
            self._step.share(rounds.finish_bodies, self.rows, [pools.slots], [self.motions])
            find(done=1)

        find(done=0)
        wp.capture_while(hit.again, solve)

    def solve(self) -> None:
        """Solve all pairs at once in rounds, until nothing changes; then stop the islands at rest."""
        pools, solved = self.pools, self.pools.rounds
        changed = [pools.slots, self.motions, pools.contacts]
        self._per_round_pair(rounds.start_rounds, solved, [], changed)
        self._repeat_rounds(rounds.solve_round, solved, [pools.contacts, pools.graph.residual])
        self._per_round_pair(rounds.finish_pairs, solved, [], [*changed, pools.graph.rounds])
        self._step.share(rounds.finish_bodies, self.rows, [pools.slots], [self.motions])
        # The velocities of islands at rest are errors of the solver.
        bodies = self.model.bodies
        inputs, changed = [self.envs, pools.rounds], [pools.graph, self.motions, pools.contacts]
        self._step.share(rest.find_held_bodies, self.most_pairs, inputs, changed, before=[self.dt])
        self._step.per_body(rest.find_restless_islands, [self.dt, bodies, *inputs], changed[:2])
        self._step.per_body(rest.stop_resting_bodies, [bodies, self.envs], changed[:2])

    def push_out(self) -> None:
        """Push-out in rounds."""
        model, pools, pushed = self.model, self.pools, self.pools.selected
        self._step.share(rounds.open_rounds, self.rows, [], [pushed], before=[0])
        inputs = [model.shapes, model.bodies, self.state, pools.pairs, self.motions, pools.contacts, pools.rounds]
        found = [pushed, pools.slots]
        self._step.share(push_rounds.find_overlaps_of_rounds, self.most_pairs, inputs, found, before=[self.dt])
        self._step.share(push_rounds.share_masses, self.most_pairs, [], [pushed])
        changed = [pools.slots, self.motions, pools.contacts]
        self._repeat_rounds(push_rounds.push_round, pushed, [pools.contacts])
        self._per_round_pair(push_rounds.finish_push, pushed, [], [*changed, pools.graph.push_out_rounds])
        self._step.share(push_rounds.store_push, self.rows, [pushed, pools.slots], [self.motions])

    def _repeat_rounds(self, kernel: Any, some: Any, changed: list) -> None:
        """Execute rounds until no environment needs another one: in groups of launches on a GPU, in one on a CPU."""
        read = [some, self.pools.slots, self.motions.solver_bodies]
        if not self.device.is_cuda:
            with self.parts.shared(some.again):
                wp.launch(kernel, 1, [0, self.parts.sharing(1), *read], changed, device=self.device)
            return
        count = min(self.most_pairs, teams.most_lanes(self.device) // rounds.LANES)
        sharing, dim = self.parts.sharing(count), count * rounds.LANES

        def group() -> None:
            for place in range(1, ROUNDS_OF_A_GROUP + 1):
                inputs = [place, sharing, *read]
                wp.launch(kernel, dim, inputs, changed, block_dim=team.SMALL_BLOCK, device=self.device)
            self._step.launch(rounds.close_rounds, 1, [ROUNDS_OF_A_GROUP], [some])

        wp.capture_while(some.again, group)

    def _per_round_pair(self, kernel: Any, some: Any, inputs: list, outputs: list, before: Sequence = ()) -> None:
        """Launch a kernel whose threads share the pairs that are solved in rounds."""
        self._step.share(kernel, self.most_pairs, [*inputs, some], outputs, before=before)
