"""Options that several commands have."""

from pathlib import Path
from typing import Annotated

import typer

ConfigArgument = Annotated[
    Path | None, typer.Argument(metavar="[CONFIG.toml]", help="Settings; what it leaves out is default.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting, such as beam.diameter_m=6.5; repeatable."),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but warnings and errors.")]
SeedOption = Annotated[int | None, typer.Option(help="Which sky and noise; the same seed, the same numbers.")]
