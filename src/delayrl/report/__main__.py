"""Write a report of files of rows: `python -m delayrl.report ROWS --out DIR`."""

import argparse
import sys
from pathlib import Path

from delayrl.errors import DelayRLError, one_line


def main() -> None:
    """Write a report of files of rows."""
    parser = argparse.ArgumentParser(prog="python -m delayrl.report", description=main.__doc__)
    parser.add_argument("rows", type=Path, nargs="+", help="files of rows, one JSON object a line")
    parser.add_argument("--out", type=Path, required=True, help="folder of the report")
    parser.add_argument("--title", default="delayrl", help="title of the report (default: delayrl)")
    given = parser.parse_args()
    try:
        with one_line("the report cannot be imported"):
            from delayrl.report.configurations import read_configs
            from delayrl.report.report import report
            from delayrl.report.rows import read_rows
        print(report(read_rows(given.rows), [], given.out, given.title, read_configs(given.rows)))
    except DelayRLError as error:
        print(f"delayrl: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
