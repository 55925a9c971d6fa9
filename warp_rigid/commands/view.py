"""`warp-rigid view`: simulate a scene or play an animation in the browser."""

from typing import Annotated, Any

import typer

from warp_rigid import interruption
from warp_rigid.commands.options import Device, Envs, Seed
from warp_rigid.commands.terminal import CAMERA_HELP, note
from warp_rigid.scenes.demo import shown_settings

FILMS = (".usd", ".usda", ".usdc", ".usdz", ".npz")


def view_command(
    scene: Annotated[
        str,
        typer.Argument(
            help="Built-in scene, .py file with a function scene(), MJCF or URDF file, or animation (USD, .npz)."
        ),
    ],
    envs: Envs = None,
    device: Device = None,
    seed: Seed = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Value, as for warp-rigid run; repeatable."),
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Simulate all variants of the scene side by side.")
    ] = False,
    camera: Annotated[str | None, typer.Option(help=CAMERA_HELP)] = None,
    host: Annotated[str, typer.Option(help="Address to listen on. The default accepts local connections only.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(help="First port to try.")] = 8080,
    paused: Annotated[bool, typer.Option("--paused", help="Start paused.")] = False,
    fast: Annotated[bool, typer.Option("--fast", help="Disable shadows, for slow graphics.")] = False,
) -> None:
    """Simulate a scene interactively in the browser, or play an animation written by `run`."""
    from warp_rigid.viewer.guard import is_loopback
    from warp_rigid.viewer.page import stop_server
    from warp_rigid.viewer.server import check_address

    check_address(host, port)
    if scene.endswith(FILMS):
        from warp_rigid.viewer.playback import FilmViewer, load_film

        film = load_film(scene, camera)
        if assignments or compare or (envs, seed) != (None, None):
            raise ValueError("--set, --envs, --seed, --compare: do not apply to an animation, which is only played")
        viewer: Any = FilmViewer(film, host, port, fast)
    else:
        from warp_rigid.viewer.live import LiveViewer
        from warp_rigid.viewer.session import Session

        session = Session(
            scene,
            assignments=assignments or (),
            num_envs=envs,
            compare=compare,
            device=device,
            seed=seed,
            camera=camera,
        )
        for name, changes in session.plan.demo.variants.items() if compare else ():
            note(f"{name}: {shown_settings(changes)}")
        session.running = not paused
        viewer = LiveViewer(session, host, port, fast)
    if not is_loopback(host):
        note(
            f"warning: --host {host}: other machines can connect without encryption; "
            "anyone with the token in the address can control the simulation"
        )
    note(f"{scene} at {viewer.server.url} (press Ctrl-C to quit)")
    try:
        viewer.run()
    except KeyboardInterrupt:
        stop_server(viewer.server)
        interruption.end(0)
