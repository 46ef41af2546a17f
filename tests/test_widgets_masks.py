"""The widget that turns a box into a mask."""

from zsp_lite.widgets.masks import example_box_to_mask


def test_the_mask_follows_the_box():
    widget = example_box_to_mask()
    first, said = widget.picture.value, widget.sentence.value
    assert "IoU" in said
    widget.controls["right"].value -= 40
    assert widget.picture.value != first and widget.sentence.value != said
    widget.controls["right"].value += 40
    assert widget.sentence.value == said


def test_an_empty_box_is_said_in_the_widget():
    widget = example_box_to_mask()
    bottom = widget.controls["bottom"].value
    widget.controls["bottom"].value = 4
    assert "the box is empty" in widget.sentence.value
    widget.controls["bottom"].value = bottom
