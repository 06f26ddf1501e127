"""Values in the messages of a declaration."""

from nlfilter_torch.photo.declared.json_values import shown


def test_values_in_messages_are_short() -> None:
    nested: list[object] = []
    for _ in range(100_000):
        nested = [nested]
    assert len(shown(nested)) < 80
    assert len(shown(["x" * 1000] * 1000)) < 300
