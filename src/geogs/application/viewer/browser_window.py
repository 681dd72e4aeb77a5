"""The page that a viewer serves: the scene and the side panel."""

import atexit
import hmac
import html
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from io import StringIO
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

import numpy as np
from jaxtyping import Float, UInt8

from geogs.errors import InputError
from geogs.evaluation.model_view.start_view import FIELD, StartView
from geogs.evaluation.pages.run_pictures import LAYERS, Layer
from geogs.extras import install_command
from geogs.geometry.camera import Camera
from geogs.geometry.lie import matrix_to_quaternion
from geogs.io.writers.exports.mesh_writers import ONE_SIDED, glb
from geogs.mesh.triangle_mesh import Mesh
from geogs.types import MapSnapshot


class GuardedServer:
    """A viser server at ``http://host:port/token/``; all other requests are refused.

    viser itself serves every client that reaches the port, and any page that is open in a browser
    can connect to it, whatever its origin.
    """

    def __init__(self, host: str, port: int, title: str) -> None:
        """Begin to serve.

        Raises:
            InputError: viser is not installed, or is one that cannot be guarded.
        """
        try:
            import viser
        except ImportError:
            raise InputError(f"The viewer needs viser: {install_command('viewer')}") from None
        self._token = secrets.token_urlsafe(16)
        self._is_guarded = False
        with redirect_stdout(StringIO()), self._guarded():  # it prints a box with the address
            self.viser = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        if not self._is_guarded:
            self.viser.stop()
            raise InputError(
                f"The viewer cannot be guarded with viser {viser.__version__}; take another "
                "version: pip install 'viser==1.1.*'."
            )
        self.address = f"http://{host}:{self.viser.get_port()}/{self._token}/"

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Guard servers of the library below viser in the block; viser has no option for it."""
        from websockets.asyncio import server

        serve = server.serve

        def guarded(*args: Any, process_request: Any = None, **more: Any) -> Any:
            self._is_guarded = process_request is not None

            def check(connection: Any, request: Any) -> Any:
                try:
                    return self._checked(connection, request, process_request)
                except Exception:  # a path or headers that cannot be parsed, here or by viser
                    return connection.respond(400, "The request cannot be understood.\n")

            return serve(*args, process_request=check, **more)

        with mock.patch.object(server, "serve", guarded):
            yield

    def _checked(self, connection: Any, request: Any, process_request: Any) -> Any:
        """Answer a request: by viser if the token and the origin are right, else by refusal."""
        path, question, query = request.path.partition("?")
        token, _, rest = path.removeprefix("/").partition("/")
        origin = request.headers.get("Origin")
        is_own = origin is None or urlsplit(origin).netloc == request.headers.get("Host")
        if not is_own or not hmac.compare_digest(token.encode(), self._token.encode()):
            return connection.respond(403, "The address stands on the terminal of geogs.\n")
        request.path = f"/{rest}{question}{query}"
        answer = process_request(connection, request)
        if answer is not None:
            answer.headers["X-Frame-Options"] = "DENY"
            answer.headers["Referrer-Policy"] = "no-referrer"
        return answer


PATH, FRUSTUM, NOW = (242, 163, 58), (111, 177, 240), (255, 209, 102)
AMBIENT = float(np.pi)
"""Ambient light for which a rough surface has exactly its own colours."""
FRUSTA, CAMERA_NOW = 0.01, 0.035
"""Lengths of frusta relative to the scene's size."""
ROOM, BESIDE = 1.3, 0.1
"""Viewing distance relative to that at which the scene fills the picture, and shift of the view to
the right as a fraction of it."""
PARTS = ("Mesh", "Disks", "Path", "Keyframes")
"""Parts of the scene, by the names of their switches."""


class Window:
    """A page at ``address`` with a scene and a panel, with or without clients."""

    def __init__(self, title: str, host: str, port: int, with_disks: bool = False) -> None:
        """Begin to serve; ``with_disks`` shows the disks from the beginning.

        Raises:
            InputError: viser is not installed, or is one that cannot be guarded.
        """
        guarded = GuardedServer(host, port, title)
        self._server = guarded.viser
        self.address = guarded.address
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        # The light is in the colours already.
        self._server.scene.configure_default_lights(False)
        self._server.scene.configure_environment_map(None)
        self._server.scene.add_light_ambient("/light", intensity=AMBIENT)
        self._server.scene.set_background_image(np.full((2, 2, 3), (27, 30, 35), np.uint8))
        gui = self._server.gui
        self._words = gui.add_html("")
        self.say(title)
        self._picture = gui.add_image(np.zeros((9, 16, 3), np.uint8), format="jpeg")
        self._layer = gui.add_dropdown("Layer", LAYERS)
        self._switches = {}
        with gui.add_folder("Show"):
            for name in PARTS:
                self._switches[name] = gui.add_checkbox(name, with_disks or name != "Disks")
                self._switches[name].on_update(lambda _: self._apply_switches())
        self._parts: dict[str, list[Any]] = {name: [] for name in self._switches}
        self._frusta: dict[int, tuple[Any, np.ndarray]] = {}
        self._size = 1.0
        atexit.register(self.stop)

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._server.get_clients())

    @property
    def layer(self) -> Layer:
        """The selected layer."""
        layer: Layer = self._layer.value
        return layer

    def on_layer(self, act: Callable[[], None]) -> None:
        """Call ``act`` whenever another layer is selected."""
        self._layer.on_update(lambda _: act())

    def add_checkbox(self, name: str, value: bool) -> Any:
        """Add a checkbox; ``value`` is its state."""
        return self._server.gui.add_checkbox(name, value)

    def add_slider(self, name: str, last: int, act: Callable[[int], None]) -> None:
        """Add a slider over numbers from 1."""
        slider = self._server.gui.add_slider(name, 1, max(last, 2), 1, 1)
        slider.on_update(lambda _: act(min(int(slider.value), last)))

    def stop(self) -> None:
        """Stop the server."""
        atexit.unregister(self.stop)
        with redirect_stdout(StringIO()):  # its thread prints that it has ended
            self._server.stop()
            time.sleep(0.3)  # for the server to end

    def say(self, heading: str, *sentences: str) -> None:
        """Set the text at the top of the panel; HTML in it is escaped."""
        words = [f"<strong>{html.escape(heading)}</strong>", *map(html.escape, sentences)]
        self._words.content = "".join(f'<p style="margin: 0.4em 1em">{w}</p>' for w in words if w)

    def show_picture(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Set the picture of the panel."""
        self._picture.image = picture

    def stand_upright(self, up: Float[np.ndarray, "3"], size: float) -> None:
        """Set the up direction of the scene, and the size that frusta are drawn for."""
        self._size = size
        self._server.scene.set_up_direction(tuple(up))

    def look_from(self, start: StartView, up: Float[np.ndarray, "3"]) -> None:
        """Set the start view of present and future clients."""

        # The panel covers the right of the window, which may be narrow besides.
        away = ROOM * (start.eye - start.target)
        target = start.target + BESIDE * np.cross(up, away)
        eye = target + away

        def look(client: Any) -> None:
            client.camera.fov = np.radians(FIELD)
            _look(client, eye, target, up)

        self._server.on_client_connect(look)
        for client in self._server.get_clients().values():
            look(client)

    def follow(self, T_wc: Float[np.ndarray, "4 4"]) -> None:
        """Move the view of all clients behind a camera."""
        eye = T_wc[:3, 3] - T_wc[:3, :3] @ np.array([0.0, 0.25, 0.6]) * self._size
        target = T_wc[:3, 3] + 0.5 * self._size * T_wc[:3, 2]
        for client in self._server.get_clients().values():
            with client.atomic():
                _look(client, eye, target, -T_wc[:3, 1])

    def show_mesh(self, mesh: Mesh) -> None:
        """Show a surface in its colours."""
        if mesh.colours is None:
            mesh = replace(mesh, colours=np.full((len(mesh.vertices), 3), 200, np.uint8))
        shown = mesh.creased()
        shape = glb(shown.vertices, shown.faces, shown.normals, shown.colours, ONE_SIDED)
        # The file is rotated by 180 degrees about x.
        turned = {"wxyz": (0.0, 1.0, 0.0, 0.0), "cast_shadow": False, "receive_shadow": False}
        self._put("Mesh", self._server.scene.add_glb("/mesh", shape, **turned))

    def show_disks(self, disks: MapSnapshot) -> None:
        """Show disks, coloured by their normals."""
        from geogs.geometry.lie import quaternion_to_matrix

        R = quaternion_to_matrix(disks.quaternion).cpu().numpy()
        scale = np.concatenate(
            [disks.scale.cpu().numpy(), 0.02 * disks.scale.cpu().numpy().min(1, keepdims=True)], 1
        )
        shape = R * scale[:, None]
        splats = self._server.scene.add_gaussian_splats(
            "/disks",
            disks.position.cpu().numpy(),
            shape @ shape.transpose(0, 2, 1),
            (0.5 + 0.45 * R[..., 2]).clip(0, 1),
            disks.opacity.cpu().numpy()[:, None],
        )
        self._put("Disks", splats)

    def show_path(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Show the path of the camera."""
        if len(points) < 2:
            return
        ends = np.stack([points[:-1], points[1:]], 1).astype(np.float32)
        line = self._server.scene.add_line_segments(
            "/path", ends, PATH, thickness=3.0, thickness_units="screen"
        )
        self._put("Path", line)

    def show_keyframe(
        self,
        id: int,
        T_wc: Float[np.ndarray, "4 4"],
        camera: Camera,
        image: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> None:
        """Show a keyframe's frustum, or move an existing one after a correction."""
        if id not in self._frusta:
            frustum = self._frustum(f"/keyframes/{id}", T_wc, camera, FRUSTUM, FRUSTA, image)
            self._parts["Keyframes"].append(frustum)
            frustum.visible = self._switches["Keyframes"].value
        else:
            frustum, before = self._frusta[id]
            if np.abs(before - T_wc).max() <= 1e-3:  # it has hardly moved
                return
            frustum.wxyz, frustum.position = _place(T_wc)
        self._frusta[id] = frustum, T_wc

    def show_camera(
        self,
        T_wc: Float[np.ndarray, "4 4"],
        camera: Camera,
        image: UInt8[np.ndarray, "h w 3"] | None,
    ) -> None:
        """Show the frustum of the present camera, or of the selected keyframe."""
        self._frustum("/camera", T_wc, camera, NOW, CAMERA_NOW, image)

    def _frustum(
        self,
        name: str,
        T_wc: Float[np.ndarray, "4 4"],
        camera: Camera,
        colour: tuple[int, int, int],
        size: float,
        image: UInt8[np.ndarray, "h w 3"] | None,
    ) -> Any:
        quaternion, position = _place(T_wc)
        return self._server.scene.add_camera_frustum(
            name,
            fov=2 * float(np.arctan2(camera.height / 2, camera.fy)),
            aspect=camera.width / camera.height,
            scale=size * self._size,
            thickness=1.0,
            thickness_units="screen",
            color=colour,
            image=image,
            format="jpeg",
            wxyz=quaternion,
            position=position,
            cast_shadow=False,
            receive_shadow=False,
        )

    def _put(self, layer: str, part: Any) -> None:
        self._parts[layer] = [part]
        part.visible = self._switches[layer].value

    def _apply_switches(self) -> None:
        for name, parts in self._parts.items():
            for part in parts:
                part.visible = self._switches[name].value


def reduced(picture: UInt8[np.ndarray, "h w 3"], longest: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Subsample a picture so that no side is longer than ``longest``."""
    step = -(-max(picture.shape[:2]) // longest)
    return np.ascontiguousarray(picture[::step, ::step])


def _look(client: Any, eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
    """Move the view of a client."""
    client.camera.up_direction = up
    client.camera.position = eye
    client.camera.look_at = target


def _place(T_wc: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion w, x, y, z and position."""
    import torch

    quaternion = matrix_to_quaternion(torch.from_numpy(np.ascontiguousarray(T_wc[:3, :3])))
    return quaternion.numpy(), T_wc[:3, 3]
