"""Words of pydantic and Python that no message to the user may contain."""

import re

INNER_WORDS = re.compile(
    r"Input should|Field required|Extra inputs|Value error|\b(union|tagged|discriminator|pydantic|tuple|dict|validation"
    r"|NoneType|mapping)\b|Settings\b|function-|should be strings",
    re.IGNORECASE,
)
