"""`make play`: a page on which a person drives the oncoming car against an opponent, on this machine only.

`python -m negopipe.play [override ...]` prints the page's address and serves it until Ctrl-C. The overrides are those
of `python -m negopipe`, such as `play.port=8080` or `play.participant=p07`; they hold for every opponent and every
street. Encounters are written to <outputs>/play/. `docs/play.md` tells more.
"""

import sys
import webbrowser
from collections.abc import Sequence
from contextlib import suppress

from negopipe.config.compose import compose_config
from negopipe.errors import UserError
from negopipe.play.arena import COMPUTED
from negopipe.play.server import Server
from negopipe.play.service import Service


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 after Ctrl-C, or 1 after a line that says what is wrong."""
    overrides = list(sys.argv[1:] if arguments is None else arguments)
    if overrides in (["-h"], ["--help"]):
        print(__doc__)
        return 0
    try:
        base = compose_config([*overrides, *COMPUTED])
        server = Server(Service(base, overrides), base.play.port)
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    with server:
        print(f"drive at   {server.address}   (Ctrl-C ends)", flush=True)
        if base.play.opens_browser:
            _open(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
    return 0


def _open(address: str) -> None:
    """Open the page in a window, where there is one for it; its address is printed anyway."""
    with suppress(webbrowser.Error, OSError):
        browser = webbrowser.get()
        if type(browser) is not webbrowser.GenericBrowser:  # which would take over the terminal
            browser.open(address)


if __name__ == "__main__":
    sys.exit(main())
