"""`python -m capture4d` is the `capture4d` command."""

from capture4d.cli.main import main

if __name__ == "__main__":
    main()
