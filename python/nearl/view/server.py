"""The web server of the live view: viser's, which answers only what was asked of this machine's own names."""

import logging
import re
from typing import Any

from nearl.view.sources import ViewError

OWN = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:\d+)?", re.IGNORECASE)
_logger = logging.getLogger("nearl.view")


def serve(port: int, label: str) -> Any:
    """A viser server on this machine alone. A page of another site, or one that was led here under another name, gets 403.

    viser has no place for such a check: it is given to the websockets server that viser makes as it starts.

    Raises:
        ViewError: viser makes its server in another way, so nothing would be checked.
    """
    import viser
    from websockets.asyncio import server

    module: Any = server
    serve_all, checked = module.serve, False

    def serve_own(*arguments: Any, process_request: Any, **settings: Any) -> Any:
        nonlocal checked
        checked = True
        return serve_all(*arguments, process_request=lambda to, asked: _refusal(to, asked) or process_request(to, asked), logger=_logger, **settings)

    _logger.addFilter(_is_own_error)
    module.serve = serve_own
    try:
        made = viser.ViserServer(host="127.0.0.1", port=port, label=label, verbose=False)
    finally:
        module.serve = serve_all
    if not checked:
        made.stop()
        raise ViewError(f"the live view cannot check who asks viser {viser.__version__}; install viser 1.1: pip install 'nearl[view]'")
    return made


def _refusal(connection: Any, request: Any) -> Any:
    """The answer to a request that names another host or comes from a page of another site; None where neither is so.

    The port is free: a tunnel may end at another one.
    """
    hosts = request.headers.get_all("Host") or [""]
    named = OWN.fullmatch(hosts[0]) is not None and len(hosts) == 1
    origins = request.headers.get_all("Origin")
    same = all(origin.lower() == f"http://{hosts[0]}".lower() for origin in origins)
    for name, given, is_own in (("Host", hosts, named), ("Origin", origins, same)):
        if not is_own:
            asked, port = ", ".join(map(repr, given)), connection.local_address[1]
            return connection.respond(403, f"nearl view: {name} of this request is {asked}, not this view's own; open http://localhost:{port}\n")
    return None


def _is_own_error(record: logging.LogRecord) -> bool:
    """False for what a client did: bytes that are no request, or a connection that it broke off while it was opened."""
    from websockets.exceptions import InvalidHandshake

    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, InvalidHandshake | ConnectionError | EOFError)
