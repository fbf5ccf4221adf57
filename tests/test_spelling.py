"""What an error says about a name that nobody knows."""

from marl_encircle.spelling import nearest


def test_a_near_name_is_proposed_else_all_are_listed_in_order() -> None:
    assert nearest("our", ["ours", "model_a"]) == "; did you mean ours?"
    assert nearest("ppo", {"matd3": 1, "maddpg": 2}) == "; known: maddpg, matd3"
