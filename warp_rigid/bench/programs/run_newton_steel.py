"""Newton with its Steel solver on the device of the problem."""

from problem import PeerProblem, main

ITERATIONS = 12
"""Of its examples."""


def run(problem: PeerProblem) -> None:
    """Step all worlds together."""
    import newton
    import newton_world

    def solver(model, capacity):
        rows = max(512, 3 * capacity)
        return newton.solvers.SolverSteel(model, iterations=ITERATIONS, free_body_constraint_max=rows)

    newton_world.run(problem, solver, {"engine": "newton_steel", "iterations": ITERATIONS})


if __name__ == "__main__":
    main(run)
