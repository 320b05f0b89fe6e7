"""The path of a picture or video, which a notebook shows."""

from base64 import b64encode
from html import escape
from pathlib import Path

LARGEST = 30_000_000  # bytes of a file that is put into a notebook; larger ones make it slow
KINDS = {".mp4": "video/mp4", ".gif": "image/gif", ".png": "image/png"}


class PictureFile(type(Path())):  # a Path of this system: before Python 3.12 a subclass of Path itself does not work
    """A Path that shows the file's content in a notebook."""

    def _repr_html_(self) -> str | None:
        kind = KINDS.get(self.suffix.lower())
        if kind is None or not self.is_file():
            return None
        if (size := self.stat().st_size) > LARGEST:
            return f"<div>{escape(str(self))}: {size / 1e6:.0f} MB, too large to show here</div>"
        data = f"data:{kind};base64,{b64encode(self.read_bytes()).decode()}"
        if kind.startswith("video"):
            return f'<video controls="" loop="" style="max-width:100%" src="{data}"></video>'
        return f'<img alt="{escape(self.name)}" style="max-width:100%" src="{data}"/>'
