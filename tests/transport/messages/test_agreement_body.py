"""What a fleet shares: told and hashed alike by all who share it, and by nobody else."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from transport.errors import EncodeError, Reason, Rejected
from transport.messages.agreement_body import (
    Agreement,
    agreement_hash,
    agreement_of,
    decode_agreement,
    encode_agreement,
)

names = st.text("abcdefghijklmnopqrstuvwxyz._", min_size=1, max_size=24)
values = st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1, max_size=300)


@given(st.dictionaries(names, values, max_size=8))
def test_it_comes_back_and_hashes_alike_in_any_order(settings: dict[str, str]) -> None:
    agreement = agreement_of(settings)
    assert decode_agreement(encode_agreement(agreement)) == agreement
    turned = agreement_of(dict(reversed(settings.items())))
    assert agreement_hash(turned) == agreement_hash(agreement)
    assert turned.differences(agreement) == ()


@given(st.dictionaries(names, values, min_size=1, max_size=8), values, st.data())
def test_another_value_is_another_hash_and_named_however_long_it_is(
    settings: dict[str, str], value: str, data: st.DataObject
) -> None:
    name = data.draw(st.sampled_from(sorted(settings)))
    longer = {key: "0" * 100 + text for key, text in settings.items()}
    for original in (settings, longer):
        changed = original | {name: original[name] + value}
        assert agreement_hash(agreement_of(changed)) != agreement_hash(agreement_of(original))
        assert agreement_of(original).differences(agreement_of(changed)) == (name,)


def test_who_is_heard_twice_is_told_and_not_hashed() -> None:
    plain = Agreement({"a": "1"})
    told = Agreement({"a": "1"}, twice=(2, 17))
    assert decode_agreement(encode_agreement(told)) == told
    assert agreement_hash(told) == agreement_hash(plain)
    assert told.differences(plain) == ()


def test_who_does_not_name_a_setting_differs_in_it() -> None:
    assert Agreement({"a": "1"}).differences(Agreement({"a": "1", "b": "2"})) == ("b",)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]",
        b'{"a":1}',
        b'{"a":""}',
        b'{"":"a"}',
        b'{"a":"\\u0000"}',
        b'{"a":"\xff"}',
        b"[" * 1000,
        b'{"a":' + b"[" * 1000,
        msgspec.json.encode({f"k{i}": "v" for i in range(25)}),
        msgspec.json.encode({"a": "v" * 49}),
        b'{"twice":"1 x"}',
        b'{"twice":"-1"}',
        '{"twice":"\u0661"}'.encode(),
    ],
)
def test_what_is_no_agreement_is_refused(body: bytes) -> None:
    with pytest.raises(Rejected) as refused:
        decode_agreement(body)
    assert refused.value.reason is Reason.MALFORMED


@pytest.mark.parametrize("settings", [{"a": "v" * 49}, {"a": ""}, {f"{i:048}": "v" * 48 for i in range(20)}])
def test_what_does_not_fit_is_not_sent(settings: dict[str, str]) -> None:
    with pytest.raises(EncodeError, match="agreement"):
        encode_agreement(Agreement(settings))
