"""`python train.py CONFIG ...` is `simreal train CONFIG ...`."""

import sys

from simreal.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
