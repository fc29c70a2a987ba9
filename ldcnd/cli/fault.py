"""`ldcnd fault`: the page of a fault or an error code, for those who have a terminal and nothing else."""

import click

from ldcnd.fault_pages import codes, page_text


@click.command()
@click.argument("code", required=False)
def command(code: str | None) -> None:
    """Explain CODE, a fault or an error: what to check, how to clear it; without CODE list all of them."""
    if code is None:
        print("\n".join(sorted(codes())))
        return
    page = page_text(code)
    if page is None:
        raise click.BadParameter(f"there is no page for {code!r}; `ldcnd fault` lists all of them", param_hint="CODE")
    print(page, end="")
