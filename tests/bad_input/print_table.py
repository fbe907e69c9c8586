"""Print the table of bad input as Markdown: ``python tests/bad_input/print_table.py``."""

import os
import tempfile
from pathlib import Path

import bad_arguments
import bad_files
import bad_programs
from bad_cases import Desk, make_trained


def main() -> None:
    """Run every case and print what the user is told."""
    parts = {
        "Arguments": bad_arguments.CASES,
        "Files": bad_files.CASES,
        "Command lines": bad_programs.CASES,
    }
    with tempfile.TemporaryDirectory() as place:
        trained = make_trained(Path(place) / "trained")
        clear = 0
        for title, cases in parts.items():
            print(f"\n## {title}\n\n| case | error | message |\n| --- | --- | --- |")
            for number, case in enumerate(cases):
                folder = Path(place) / f"{title}-{number}"
                folder.mkdir()
                os.chdir(folder)
                message = case.message(Desk(folder, trained))
                clear += all(words in message for words in case.words)
                print("|", " | ".join((case.name, case.error.__name__, message.replace("|", "\\|"))), "|")
        print(f"\n{clear} of {sum(map(len, parts.values()))} name the argument, what was given and what is allowed.")


if __name__ == "__main__":
    main()
