"""Who may do what: tokens, what counts as this machine, and which pages may connect from a browser.

Without a token only this machine is served. A token is compared by its SHA-256, in constant time; the configuration
may hold that instead of the token itself.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
from collections.abc import Collection, Mapping
from urllib.parse import urlsplit

HASHED = "sha256:"


def token_matches(given: str, configured: str) -> bool:
    """Whether a token is the configured one, which is in plain text or `sha256:` and its 64 hexadecimal digits."""
    digest = hashlib.sha256(given.encode(errors="replace")).hexdigest()
    if configured.startswith(HASHED):
        expected = configured.removeprefix(HASHED).lower()
    else:
        expected = hashlib.sha256(configured.encode()).hexdigest()
    return hmac.compare_digest(digest, expected)


def bearer(headers: Mapping[str, str]) -> str:
    """The token of `Authorization: Bearer <token>`, "" without one. `headers`: names in lower case."""
    scheme, _, token = headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


def is_local(peer: str, headers: Mapping[str, str]) -> bool:
    """Whether a request is from this machine: from a loopback address, to a loopback name, past no proxy.

    The name, because a page of anybody's can be made to reach this machine under a name of its own (DNS rebinding);
    the proxy, because all that it forwards comes from its own address. `headers`: names in lower case.
    """
    proxied = "forwarded" in headers or "x-forwarded-for" in headers
    return not proxied and is_loopback(peer) and is_loopback(_hostname(headers.get("host", "")))


def is_loopback(host: str) -> bool:
    """`localhost`, or an address of this machine for itself."""
    if host == "localhost" or host.endswith(".localhost"):
        return True
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback


def origin_allowed(headers: Mapping[str, str], local: bool, allowed: Collection[str]) -> bool:
    """Whether the page that opens a connection may: ours, one of `allowed`, and on this machine any of its own pages.

    Programs other than browsers send no Origin. `headers`: names in lower case.
    """
    origin = headers.get("origin")
    if origin is None or origin in allowed:
        return True
    try:
        url = urlsplit(origin)
        if url.netloc.lower() == headers.get("host", "").lower() != "":
            return True
        return local and (url.scheme == "file" or is_loopback(url.hostname or ""))
    except ValueError:
        return False


def _hostname(host: str) -> str:
    """Of a Host header, without the port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
