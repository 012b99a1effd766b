"""Whether the packages of the server are there: the client and the command line do without them."""

from importlib.util import find_spec

from stickslip_services.errors import ServerNotInstalledError

_SERVER_MODULES = ("alembic", "fastapi", "jinja2", "prometheus_client", "pydantic_settings", "sqlalchemy", "uvicorn")


def require_server(command: str) -> None:
    """Raise ServerNotInstalledError where the packages of the server are missing."""
    missing = [name for name in _SERVER_MODULES if find_spec(name) is None]
    if missing:
        raise ServerNotInstalledError(
            f"`stickslip {command}` needs the server, and {', '.join(missing)} is not installed: "
            "pip install 'stickslip-services[server]'"
        )
