"""The cameras that this machine has: who they are and what they can do."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

from companion.errors import SourceError
from companion.frames.v4l2.device import ControlInfo, Identity, PixelFormat, VideoDevice
from companion.frames.v4l2.kernel import Kernel


@dataclass(frozen=True, slots=True)
class CameraListing:
    """One camera.

    Attributes
    ----------
    path
        Its node now.
    links
        Its names that last.
    identity
        Driver, model and bus.
    formats, controls
        What it offers.
    fault
        Why it could not be asked, or "".
    """

    path: str
    links: tuple[str, ...]
    identity: Identity
    formats: tuple[PixelFormat, ...]
    controls: tuple[ControlInfo, ...]
    fault: str = ""


def list_cameras(kernel: Kernel) -> tuple[CameraListing, ...]:
    """Ask every video node; those that are no cameras (metadata, codecs) are left out."""
    found = []
    for node in kernel.nodes():
        try:
            opened = kernel.open(node.path)
        except OSError as error:
            nobody = Identity("", "", "")
            found.append(CameraListing(node.path, node.links, nobody, (), (), error.strerror or str(error)))
            continue
        with contextlib.closing(opened), contextlib.suppress(SourceError):
            try:
                device = VideoDevice(opened, node.path)
                found.append(
                    CameraListing(node.path, node.links, device.identity, device.formats(), device.controls())
                )
            except OSError as error:  # unplugged meanwhile, or no video device at all
                nobody = Identity("", "", "")
                found.append(
                    CameraListing(node.path, node.links, nobody, (), (), error.strerror or str(error))
                )
    return tuple(found)
