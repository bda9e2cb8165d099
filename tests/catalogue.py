"""Catalogues of what can go wrong, row by row, and the tests that stand for the rows."""

import ast
from pathlib import Path


def without_a_test(places) -> list[str]:
    """Those of the places "file::function" where no such test is."""

    def there(place):
        name, _, function = place.partition("::")
        (path,) = Path(__file__).parent.rglob(f"{name}.py")
        return function in {x.name for x in ast.parse(path.read_text()).body if isinstance(x, ast.FunctionDef)}

    return [place for place in places if not there(place)]
