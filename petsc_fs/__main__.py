"""Entry point of `python -m petsc_fs` and of `petsc-fs`."""

import sys

from petsc_fs.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
