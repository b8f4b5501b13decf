"""Table of network addresses to which webhooks may or may not be sent."""

from ipaddress import ip_network

import pytest

from marey_server.access.network_addresses import literal_address, may_connect

PUBLIC = ("8.8.8.8", "1.1.1.1", "193.99.144.80", "2a02:2e0:3fe:1001::1", "2606:4700::1111", "::ffff:8.8.8.8")
REFUSED = {
    "unspecified": ("0.0.0.0", "0.1.2.3", "::"),
    "loopback": ("127.0.0.1", "127.255.255.254", "::1"),
    "private": ("10.0.0.1", "172.16.0.1", "172.31.255.255", "192.168.1.1", "fc00::1", "fd12:3456::1", "fec0::1"),
    "link-local": ("169.254.169.254", "fe80::1", "fe80::1%eth0"),
    "between providers and customers": ("100.64.0.1", "100.127.255.255"),
    "multicast": ("224.0.0.1", "239.255.255.255", "ff02::1", "ff0e::1"),
    "reserved": ("240.0.0.1", "255.255.255.255", "192.0.0.8", "198.18.0.1", "192.0.2.1", "203.0.113.9", "2001:db8::1"),
    "IPv4 in IPv6": ("::ffff:127.0.0.1", "::ffff:10.0.0.1", "::ffff:169.254.169.254", "::127.0.0.1", "::a00:1"),
    "6to4": ("2002:7f00:1::", "2002:a00:1::1", "2002:808:808::1", "192.88.99.1"),
    "NAT64": ("64:ff9b::7f00:1", "64:ff9b::a00:1", "64:ff9b::808:808", "64:ff9b:1::1"),
    "Teredo": ("2001:0:4136:e378:8000:63bf:3fff:fdd2",),
}
LITERALS = {
    "10.0.0.1": "10.0.0.1",
    "127.1": "127.0.0.1",
    "0x7f000001": "127.0.0.1",
    "0x7f.1": "127.0.0.1",
    "0177.0.0.1": "127.0.0.1",
    "2130706433": "127.0.0.1",
    "127.0.0.1.": "127.0.0.1",
    "::1": "::1",
    "fe80::1%25eth0": "fe80::1",
    "localhost": "127.0.0.1",
    "LOCALHOST.": "127.0.0.1",
    "db.localhost": "127.0.0.1",
    "example.org": None,
    "1.example.cafe": None,
    "127.0.0.1.example.org": None,
    "1and1.de": None,
    "": None,
}


@pytest.mark.parametrize("address", PUBLIC)
def test_public_addresses_are_permitted(address: str) -> None:
    assert may_connect(address, ())


@pytest.mark.parametrize(("what", "address"), [(what, one) for what, many in REFUSED.items() for one in many])
def test_other_addresses_are_refused(what: str, address: str) -> None:
    assert not may_connect(address, ()), what


def test_the_operator_can_permit_networks_and_only_these() -> None:
    allowed = (ip_network("10.1.0.0/16"), ip_network("fd00:12::/32"), ip_network("64:ff9b::a01:0/112"))
    permitted = ("10.1.2.3", "::ffff:10.1.2.3", "fd00:12::7", "64:ff9b::a01:5", "8.8.8.8")
    assert all(may_connect(one, allowed) for one in permitted)
    refused = ("10.2.0.1", "::ffff:10.2.0.1", "fd00:13::1", "2002:a01:203::1", "127.0.0.1")
    assert not any(may_connect(one, allowed) for one in refused)


@pytest.mark.parametrize(("host", "address"), LITERALS.items())
def test_all_forms_of_numeric_addresses_are_recognised(host: str, address: str | None) -> None:
    assert literal_address(host) == address
