"""`ldcnd fault`: the page of a fault or an error code, for those who have a terminal and nothing else."""

from difflib import get_close_matches

import click
from click.shell_completion import CompletionItem

from ldcnd.contract.fault_pages import codes, page_text


class Code(click.types.StringParamType):
    """A code that has a page; the shell completes it."""

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002
        """Return the codes that begin so."""
        return [CompletionItem(code) for code in sorted(codes()) if code.startswith(incomplete)]


@click.command()
@click.argument("code", required=False, type=Code())
def command(code: str | None) -> None:
    """Explain CODE, a fault or an error: what to check, how to clear it; without CODE list all of them."""
    if code is None:
        print("\n".join(sorted(codes())))
        return
    page = page_text(code)
    if page is None:
        near = next(iter(get_close_matches(code, codes(), 1)), None)
        meant = f"did you mean {near!r}? " if near else ""
        raise click.BadParameter(
            f"there is no page for {code!r}; {meant}`ldcnd fault` lists all of them", param_hint="CODE"
        )
    print(page, end="")
