"""`warp-rigid view`: simulate a scene or play an animation in the browser."""

from dataclasses import dataclass
from typing import Annotated, Any

import typer

from warp_rigid import interruption
from warp_rigid.commands.options import Device, Envs, Seed, takes
from warp_rigid.commands.terminal import CAMERA_HELP, note
from warp_rigid.scenes.demo import shown_settings

FILMS = (".usd", ".usda", ".usdc", ".usdz", ".npz")


@dataclass(frozen=True)
class ViewOptions:
    """Options of `warp-rigid view`."""

    scene: Annotated[
        str,
        typer.Argument(
            help="Built-in scene, .py file with a function scene(), MJCF or URDF file, or animation (USD, .npz)."
        ),
    ]
    envs: Envs = None
    device: Device = None
    seed: Seed = None
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Value, as for warp-rigid run; repeatable."),
    ] = None
    compare: Annotated[bool, typer.Option("--compare", help="Simulate all variants of the scene side by side.")] = False
    camera: Annotated[str | None, typer.Option(help=CAMERA_HELP)] = None
    host: Annotated[str, typer.Option(help="Address to listen on. The default accepts local connections only.")] = (
        "127.0.0.1"
    )
    port: Annotated[int, typer.Option(help="First port to try.")] = 8080
    paused: Annotated[bool, typer.Option("--paused", help="Start paused.")] = False
    fast: Annotated[bool, typer.Option("--fast", help="Disable shadows, for slow graphics.")] = False


@takes(ViewOptions)
def view_command(options: ViewOptions) -> None:
    """Simulate a scene interactively in the browser, or play an animation written by `run`."""
    from warp_rigid.viewer.guard import is_loopback
    from warp_rigid.viewer.page import stop_server
    from warp_rigid.viewer.server import check_address

    host, port, fast = options.host, options.port, options.fast
    check_address(host, port)
    if options.scene.endswith(FILMS):
        from warp_rigid.viewer.playback import FilmViewer, load_film

        film = load_film(options.scene, options.camera)
        if options.assignments or options.compare or (options.envs, options.seed) != (None, None):
            raise ValueError("--set, --envs, --seed, --compare: do not apply to an animation, which is only played")
        viewer: Any = FilmViewer(film, host, port, fast)
    else:
        from warp_rigid.viewer.live import LiveViewer
        from warp_rigid.viewer.session import Session

        session = Session(
            options.scene,
            assignments=options.assignments or (),
            num_envs=options.envs,
            compare=options.compare,
            device=options.device,
            seed=options.seed,
            camera=options.camera,
        )
        for name, changes in session.plan.demo.variants.items() if options.compare else ():
            note(f"{name}: {shown_settings(changes)}")
        session.running = not options.paused
        viewer = LiveViewer(session, host, port, fast)
    if not is_loopback(host):
        note(
            f"warning: --host {host}: other machines can connect without encryption; "
            "anyone with the token in the address can control the simulation"
        )
    note(f"{options.scene} at {viewer.server.url} (press Ctrl-C to quit)")
    try:
        viewer.run()
    except KeyboardInterrupt:
        stop_server(viewer.server)
        interruption.end(0)
