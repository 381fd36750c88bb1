"""Tables: rows are whole, counted, and nobody else's."""

import pytest

from jaxrod.training.runs.table import Table


@pytest.fixture
def table(tmp_path):
    table = Table(tmp_path / "table.csv")
    table.append([{"step": k, "return": k / 2} for k in range(5)])
    return table


def rows(table):
    return [int(row["step"]) for row in table.read()]


def test_it_is_cut_back_to_what_was_marked_and_goes_on_from_there(table):
    mark = table.mark()
    assert mark["rows"] == 5
    table.append([{"step": 5, "return": 0.0}, {"step": 6, "return": 0.0}])
    with table.path.open("a") as stream:
        stream.write("7")  # killed in the middle of a row
    assert rows(table) == list(range(7))
    again = Table(table.path)
    again.cut(mark)
    again.append([{"step": 50, "return": 1.0}])
    assert rows(again) == [0, 1, 2, 3, 4, 50]
    assert again.mark()["rows"] == 6


@pytest.mark.parametrize(
    ("keep", "said"),
    [
        (-1, "has 4 complete rows, but the checkpoint counts 5: rows are lost"),
        (20, "has 1 complete rows, but the checkpoint counts 5"),
        (0, "has 0 complete rows, but the checkpoint counts 5"),
    ],
)
def test_lost_rows_are_counted_and_nothing_is_touched(table, keep, said):
    mark, content = table.mark(), table.path.read_bytes()[:keep]
    table.path.write_bytes(content)
    with pytest.raises(ValueError, match=f"table.csv {said}"):
        Table(table.path).cut(mark)
    assert table.path.read_bytes() == content


def test_changed_rows_are_noticed(table):
    mark = table.mark()
    table.path.write_text(table.path.read_text().replace("3,1.5", "3,2.5"))
    with pytest.raises(ValueError, match=r"table\.csv does not match the checkpoint"):
        Table(table.path).cut(mark)


def test_rows_of_somebody_else_are_noticed_before_the_next_is_written(table):
    other = Table(table.path)
    other.cut(table.mark())
    other.append([{"step": 9, "return": 0.0}])
    content = table.path.read_bytes()
    with pytest.raises(ValueError, match=r"another program .*table\.csv"):
        table.append([{"step": 5, "return": 0.0}])
    assert table.path.read_bytes() == content


def test_rows_of_other_columns_are_not_mixed_in(table):
    with pytest.raises(ValueError, match=r"the columns step,return; .* step,loss does"):
        table.append([{"step": 5, "loss": 0.0}])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"a,b\n1,2\n3\n", "row 2 has 1 values for 2 columns"),
        (b"a,b\n1,2,3\n", "row 1 has 3 values for 2 columns"),
        (b"a,b\n\xff\xfe\x00,1\n", "UnicodeDecodeError"),
        (b'a,b\n"1"x,2\n', "expected after"),
    ],
)
def test_a_damaged_table_is_named(tmp_path, content, said):
    (tmp_path / "table.csv").write_bytes(content)
    with pytest.raises(ValueError, match=f"table.csv is damaged: .*{said}"):
        Table(tmp_path / "table.csv").read()


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("step,return\n0,0.0\n1,0.5\n2,\n3,1.5\n4,2.0\n", "row 3 .* column 'return'"),
        ("step,return\n,0.0\n1,0.5\n2,1.0\n3,1.5\n4,2.0\n", "row 1 .* column 'step'"),
        ("step,return\n0,\n1,0.5\n,1.0\n3,1.5\n4,2.0\n", "row 3 .* column 'step'"),
    ],
)
def test_an_empty_value_is_named_by_its_row_and_column(table, lines, said):
    """A column with values above goes first: a column may begin without any."""
    mark = table.mark()
    table.path.write_text(lines)
    with pytest.raises(ValueError, match=rf"table\.csv has its 5 rows, but .*: {said}"):
        Table(table.path).check(mark)


def test_shorter_values_are_no_lost_rows(table):
    mark = table.mark()
    table.path.write_text(table.path.read_text().replace("0.5", "5"))
    with pytest.raises(ValueError, match=r"its 5 rows, but .* have become shorter"):
        Table(table.path).check(mark)
