"""Who may do what: tokens, what counts as this machine, and which pages may connect from a browser.

Without a token only this machine is served. A token is compared by its SHA-256, in constant time; the configuration
may hold that instead of the token itself.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import ssl
from collections.abc import Collection, Mapping
from urllib.parse import urlsplit

HASHED = "sha256:"


class CertificateError(ValueError):
    """A TLS certificate or key that cannot be used. The text names the file and what would be right."""


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
        # `file://` is what microcontrollers' libraries say, and no page from the network can.
        return url.scheme == "file" or (local and is_loopback(url.hostname or ""))
    except ValueError:
        return False


def _hostname(host: str) -> str:
    """Of a Host header, without the port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def tls(certificate: str, key: str) -> ssl.SSLContext | None:
    """For a server with this certificate and key, paths of PEM files; None for "". Raises CertificateError."""
    if not certificate:
        return None
    for path, what in ((certificate, "certificate"), (key, "key")):
        try:
            with open(path, encoding="ascii") as file:
                text = file.read()
        except (OSError, UnicodeDecodeError) as error:
            reason = (error.strerror or str(error)).lower() if isinstance(error, OSError) else "not a PEM file"
            raise CertificateError(f"[server] {what}: {path}: {reason}; the README says how to make one") from None
        begin = "BEGIN CERTIFICATE" if what == "certificate" else "PRIVATE KEY"
        if begin not in text:
            raise CertificateError(f"[server] {what}: {path} is no {what}: there is no line with {begin}")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)

    def ask() -> str:
        raise CertificateError(f"[server] key: {key} has a password; `openssl pkey -in {key}` writes it without")

    try:
        context.load_cert_chain(certificate, key, ask)
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).lower().replace("_", " ")
        raise CertificateError(f"[server] certificate: {certificate} with the key {key}: {reason}") from None
    return context
