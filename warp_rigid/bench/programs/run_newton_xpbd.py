"""Newton with its XPBD solver on the device of the problem."""

from problem import PeerProblem, main

ITERATIONS = 10
"""Its examples use 2 to 20, at ten steps a frame."""


def run(problem: PeerProblem) -> None:
    """Step all worlds together."""
    import newton
    import newton_world

    def solver(model, capacity):
        bounces = problem.restitution > 0.0
        return newton.solvers.SolverXPBD(model, iterations=ITERATIONS, enable_restitution=bounces)

    newton_world.run(problem, solver, {"engine": "newton_xpbd", "iterations": ITERATIONS})


if __name__ == "__main__":
    main(run)
