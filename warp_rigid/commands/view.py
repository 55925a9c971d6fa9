"""`warp-rigid view`: a scene or a film in the browser."""

from typing import Annotated, Any

import typer

from warp_rigid.commands.terminal import note

FILMS = (".usd", ".usda", ".usdc", ".usdz", ".npz")


def view_command(
    scene: Annotated[str, typer.Argument(help="A built-in scene, a .py file with scene(), or a film to play.")],
    envs: Annotated[int | None, typer.Option(help="Environments.")] = None,
    device: Annotated[str | None, typer.Option(help="Such as cpu or cuda:0.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of the scene's random numbers.")] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="As for warp-rigid run."),
    ] = None,
    compare: Annotated[bool, typer.Option("--compare", help="All variants of the scene side by side.")] = False,
    host: Annotated[str, typer.Option(help="Address; the default is for this machine alone.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="The first to try.")] = 8080,
    paused: Annotated[bool, typer.Option("--paused", help="Wait for a press on Run.")] = False,
    fast: Annotated[bool, typer.Option("--fast", help="Simple light without shadows, for slow graphics.")] = False,
) -> None:
    """Play with a scene in the browser, or watch a film that `run` wrote."""
    from warp_rigid.viewer.guard import is_loopback
    from warp_rigid.viewer.page import stop_server
    from warp_rigid.viewer.server import check_address

    check_address(host, port)
    if scene.endswith(FILMS):
        from warp_rigid.viewer.playback import FilmViewer, load_film

        viewer: Any = FilmViewer(load_film(scene), host, port, fast)
    else:
        from warp_rigid.viewer.live import LiveViewer
        from warp_rigid.viewer.session import Session

        session = Session(
            scene, assignments=assignments or (), num_envs=envs, compare=compare, device=device, seed=seed
        )
        session.running = not paused
        viewer = LiveViewer(session, host, port, fast)
    if not is_loopback(host):
        note(
            f"warning: --host {host}: other machines can connect, without encryption; "
            "anyone who has the token in the address can control the simulation"
        )
    note(f"{scene} at {viewer.url} (Ctrl-C ends)")
    try:
        viewer.run()
    except KeyboardInterrupt:
        stop_server(viewer.server)
