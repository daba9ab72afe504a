"""``python -m occdetr.study``: see ``occdetr.study.plan``."""

from occdetr.study.plan import main

if __name__ == "__main__":
    main()
