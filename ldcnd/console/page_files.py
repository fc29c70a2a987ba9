"""The files of the pages, as they were at the start: a release that is installed meanwhile is for the next start.

A console of before serves no page that counts on what only the console of its own release does.
"""

import hashlib
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from mimetypes import guess_type

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

ENTRY = "index.html"


@dataclass(frozen=True, slots=True)
class PageFile:
    """A file that browsers load.

    Attributes:
        content: its bytes.
        media_type: what they are.
        tag: tells them from others, for a browser that has them already.
    """

    content: bytes
    media_type: str
    tag: str

    def answer(self, request: Request) -> Response:
        """Answer with the file, or that a browser has it."""
        headers = {"ETag": self.tag}
        known = request.headers.get("if-none-match", "")
        if self.tag in [each.strip().removeprefix("W/") for each in known.split(",")]:
            return Response(status_code=304, headers=headers)
        return Response(self.content, media_type=self.media_type, headers=headers)


def page_file_routes() -> list[BaseRoute]:
    """Read the files of the pages, and return what serves them."""
    found = dict(_read(files("ldcnd.console") / "static", ""))

    async def entry(request: Request) -> Response:
        return found[ENTRY].answer(request)

    async def file(request: Request) -> Response:
        asked = found.get(request.path_params["path"])
        return asked.answer(request) if asked else PlainTextResponse("There is no such file.", 404)

    return [Route("/", entry), Route("/static/{path:path}", file)]


def _read(folder: Traversable, below: str) -> list[tuple[str, PageFile]]:
    """Return the files of a folder and of those in it, by their paths."""
    read: list[tuple[str, PageFile]] = []
    for each in folder.iterdir():
        path = f"{below}{each.name}"
        if each.is_dir():
            read += _read(each, f"{path}/")
        else:
            content = each.read_bytes()
            tag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
            read.append((path, PageFile(content, guess_type(path)[0] or "text/plain", tag)))
    return read
