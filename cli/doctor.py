"""``ohmskin doctor``: what is installed, which ports are there, and what to type to mend what is not right."""

from __future__ import annotations

from dataclasses import asdict

import click

from ..common.text import one_line
from ..doctor import Finding, State, examine_device, examine_installation, examine_ports, examine_traffic
from ..errors import LinkError
from . import arguments
from ._json import json_text


@click.command(
    epilog=arguments.example(
        "ohmskin doctor",
        "ohmskin doctor /dev/ttyUSB0",
    )
)
@click.argument("port", required=False)
@arguments.as_json("the findings")
def command(port: str | None, as_json: bool) -> int:
    """Look at this installation and its serial ports, or at PORT alone, and say what to type to mend each problem.

    Exit code 0: no problem; 3: a problem. A missing optional part is no problem.
    """
    findings = [*examine_installation(), *examine_ports()] if port is None else _examine_port(port)
    if as_json:
        click.echo(json_text([asdict(finding) for finding in findings], indent=1))
    else:
        for finding in findings:
            _show(finding)
    return 3 if any(finding.state is State.PROBLEM for finding in findings) else 0


def _examine_port(port: str) -> list[Finding]:
    """The device first; its traffic only where the device can be opened."""
    findings = [] if "://" in port else examine_device(port)
    try:
        return [*findings, *examine_traffic(port)]
    except LinkError as error:
        if any(finding.state is State.PROBLEM for finding in findings):
            return findings  # which say why it cannot be opened
        return [*findings, Finding(State.PROBLEM, port, str(error).removeprefix(f"{port}: "))]


def _show(finding: Finding) -> None:
    click.echo(f"{finding.state:<9} {one_line(finding.subject)}: {one_line(finding.found)}")
    if finding.mend:
        click.echo(f"{'':9}   -> {one_line(finding.mend)}")
