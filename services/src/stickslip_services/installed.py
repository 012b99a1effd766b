"""Detection of the server packages, which the client and most commands do without."""

from importlib.util import find_spec

from stickslip_services.errors import ServerNotInstalledError

_SERVER_MODULES = ("alembic", "fastapi", "jinja2", "prometheus_client", "pydantic_settings", "sqlalchemy", "uvicorn")


def require_server() -> None:
    """Raise ServerNotInstalledError if a package of the server is missing."""
    missing = [name for name in _SERVER_MODULES if find_spec(name) is None]
    if missing:
        raise ServerNotInstalledError(
            f"this command needs the server, and {', '.join(missing)} is not installed: "
            "pip install 'stickslip-services[server]'"
        )
