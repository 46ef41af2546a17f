"""The widget that segments the object in a box."""

from tools.widget_examples import box_to_mask


def test_the_mask_follows_the_box():
    widget = box_to_mask()
    first, text = widget.picture.value, widget.caption.value
    assert "IoU" in text
    widget.controls["right"].value -= 40
    assert widget.picture.value != first and widget.caption.value != text
    widget.controls["right"].value += 40
    assert widget.caption.value == text


def test_an_empty_box_is_reported_in_the_caption():
    widget = box_to_mask()
    bottom = widget.controls["bottom"].value
    widget.controls["bottom"].value = 4
    assert "the box is empty" in widget.caption.value
    widget.controls["bottom"].value = bottom
