"""Fields of TIFF structures, with their type, place and value."""

import math

import pytest

from nlfilter_torch.photo.files.tables import TiffTables
from tests.files import MAKER_NOTE, camera_block


@pytest.mark.parametrize("order", ["<", ">"])
def test_fields_have_types_places_and_values(order: str) -> None:
    tables = TiffTables(camera_block(order)[6:])
    fields = {field.code: field for field in tables.walk()}
    assert (tables.order, tables.big, tables.first) == (order, False, 8)
    assert tables.raw(fields[37500]) == MAKER_NOTE
    assert tables.number(fields[274]) == 6
    assert tables.number(fields[271]) is None
    assert math.isnan(tables.ratio(fields[271]))
    assert [field.code for field in tables.fields(8)] == [271, 274, 34665, 34853]
    assert tables.fields(10**9) == tables.fields(0) == []
    assert all(stop <= len(tables.data) for _, stop in tables.ranges())


def test_other_data_is_refused() -> None:
    with pytest.raises(ValueError, match="no header of TIFF"):
        TiffTables(b"JFIF and more")
