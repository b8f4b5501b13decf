"""Network addresses that the server may connect to for a user: public ones, and those that the operator allows.

Users give URLs to the server, so the server could be used to reach machines behind a firewall. Therefore addresses of
private networks are refused, even if they are written in an unusual form or embedded in an IPv6 address.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from urllib.parse import urlsplit

Address = IPv4Address | IPv6Address
Network = IPv4Network | IPv6Network

_LOOPBACK = IPv4Address("127.0.0.1")
_REFUSED: tuple[Network, ...] = tuple(
    map(
        ip_network,
        (
            "0.0.0.0/8",
            "10.0.0.0/8",
            "100.64.0.0/10",  # between providers and their customers
            "127.0.0.0/8",
            "169.254.0.0/16",
            "172.16.0.0/12",
            "192.0.0.0/24",
            "192.88.99.0/24",  # relays of 6to4
            "192.168.0.0/16",
            "198.18.0.0/15",
            "224.0.0.0/4",
            "240.0.0.0/4",
            "::/96",  # contains an IPv4 address
            "64:ff9b::/96",  # NAT64: contains an IPv4 address
            "64:ff9b:1::/48",
            "100::/64",
            "2001::/23",  # contains Teredo, which contains an IPv4 address
            "2002::/16",  # 6to4: contains an IPv4 address
            "fc00::/7",
            "fe80::/10",
            "fec0::/10",
            "ff00::/8",
        ),
    )
)
"""Networks that are not public, and networks whose addresses contain an IPv4 address, such as those of NAT64."""


def may_connect(address: str, allowed: Iterable[Network]) -> bool:
    """Return whether the server may connect to a numeric address: a public one, or one in a network of `allowed`."""
    found = _parsed(address)
    if any(found.version == network.version and found in network for network in allowed):
        return True
    return found.is_global and not any(found.version == one.version and found in one for one in _REFUSED)


def _parsed(address: str) -> Address:
    """Parse an address, without its zone; `::ffff:1.2.3.4` becomes the IPv4 address `1.2.3.4`."""
    found = ip_address(address.partition("%")[0])
    return found.ipv4_mapped or found if isinstance(found, IPv6Address) else found


def literal_address(host: str) -> str | None:
    """Convert the host of a URL to a numeric address; return None if it is a name that must be resolved.

    Old forms of IPv4 addresses, such as `127.1` or `0x7f000001`, are converted, too, and so is `localhost`.
    """
    name = host.rstrip(".").lower()
    if name == "localhost" or name.endswith(".localhost"):
        return str(_LOOPBACK)
    try:
        return str(ip_address(name.partition("%")[0]))
    except ValueError:
        pass
    if not name or name[-1] not in "0123456789abcdef" or not name[0].isdigit():
        return None
    try:
        return socket.inet_ntoa(socket.inet_aton(name))
    except OSError:
        return None


def read_network(text: object) -> Network:
    """Return the network that a text names, such as 10.1.0.0/16.

    Raises `ValueError` if the text names none, or if it names an address in a network instead.
    """
    try:
        return ip_network(str(text))
    except ValueError:
        pass
    try:
        network = ip_network(str(text), strict=False)
    except ValueError:
        raise ValueError(f"{str(text)!r} is not a network, such as 10.1.0.0/16") from None
    raise ValueError(f"{text} is an address in a network; the network is {network}")


def is_protected(url: str) -> bool:
    """Return whether a URL is safe from eavesdropping: https, or http with an address of this machine."""
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port  # which is a number only if the URL is well formed
    except ValueError:
        return False
    if not host or not url.isascii() or not url.isprintable() or " " in url:
        return False
    address = literal_address(host) if parts.scheme == "http" else None
    return parts.scheme == "https" or (address is not None and ip_address(address).is_loopback)
