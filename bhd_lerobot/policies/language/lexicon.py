"""The words and the word order of instructions, in English and in Chinese.

Each word or phrase has a `Part`. An instruction is understood if its parts, one letter each, match a pattern of its
language from beginning to end; a word that is not here therefore never passes unnoticed.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from bhd_lerobot.bodies.tabletop import COLOURS, KINDS

ANYTHING = "thing"  # the value of a noun that fits every kind


class Part(StrEnum):
    """What a word does in an instruction; the value is its letter in the patterns."""

    LIFT = "V"  # a verb after which the arm holds the object
    GIVE = "H"  # a verb after which the person has it
    BRING = "K"  # the same, also without saying to whom
    TAKE = "T"  # a verb that lifts, or that gives where "to me" stands with it
    PASS = "E"  # a verb that needs a "to me"
    ME = "M"
    TO_ME = "G"
    UP = "U"
    OVER = "W"
    POLITE = "P"
    THE = "D"
    OF = "d"
    COLOUR = "C"
    WHICH = "R"  # a place or a size that stands before the noun
    WHERE = "Q"  # a place that stands after it
    ASIDE = "q"  # the same, which after some verbs may also be where it is to go
    TABLE = "L"
    FROM = "F"
    OBJECT_FIRST = "B"  # the object comes before the verb
    NOUN = "N"
    NOT = "X"
    SEVERAL = "A"
    UNKNOWN = "x"


VERBS = frozenset((Part.LIFT, Part.GIVE, Part.BRING, Part.TAKE, Part.PASS))


class Relation(StrEnum):
    """How one object differs from the others that colour and kind fit."""

    LEFT = "left"
    RIGHT = "right"
    NEAREST = "nearest"
    FARTHEST = "farthest"
    BIGGEST = "biggest"
    SMALLEST = "smallest"


Words = dict[str, tuple[Part, str]]


@dataclass(frozen=True)
class Language:
    """Words and word order of one language."""

    words: Words
    lift: re.Pattern[str]
    give: re.Pattern[str]
    names: dict[str, str]
    verbs: str
    example: str

    def listing(self, names: Iterable[str]) -> str:
        """Return how to say several names."""
        return ", ".join(self.names[name] for name in names)


def _words(entries: dict[tuple[Part, str], str]) -> Words:
    """Return part and value by word, from words separated by semicolons by part and value."""
    return {word.strip(): entry for entry, words in entries.items() for word in words.split(";")}


_ENGLISH_WORDS = _words(
    {
        (Part.LIFT, ""): "pick up; pick; lift up; lift; grab; grasp; raise",
        (Part.TAKE, ""): "take",
        (Part.GIVE, ""): "hand; give",
        (Part.BRING, ""): "hand over; bring; bring over; fetch; get; pass; pass over",
        (Part.ME, ""): "me",
        (Part.TO_ME, ""): "to me; over to me",
        (Part.UP, ""): "up",
        (Part.OVER, ""): "over; here; over here",
        (Part.POLITE, ""): (
            "please; kindly; sorry; excuse me; robot; hey; hello; hi; thanks; thank you; could you; can you; "
            "would you; will you; could you please; can you please; would you please; will you please"
        ),
        (Part.THE, ""): "the; a; an; this; that",
        (Part.WHICH, Relation.LEFT): "left; leftmost; left-most; left-hand",
        (Part.WHICH, Relation.RIGHT): "right; rightmost; right-most; right-hand",
        (Part.WHICH, Relation.NEAREST): "nearest; closest; near",
        (Part.WHICH, Relation.FARTHEST): "farthest; furthest; most distant; far",
        (Part.WHICH, Relation.BIGGEST): "biggest; bigger; big; largest; larger; large",
        (Part.WHICH, Relation.SMALLEST): "smallest; smaller; small; littlest; little",
        (Part.WHERE, Relation.LEFT): (
            "on the left; on the left side; on the left-hand side; on the left hand side; at the left; on your left"
        ),
        (Part.ASIDE, Relation.LEFT): "to the left; to your left",
        (Part.WHERE, Relation.RIGHT): (
            "on the right; on the right side; on the right-hand side; on the right hand side; at the right; "
            "on your right"
        ),
        (Part.ASIDE, Relation.RIGHT): "to the right; to your right",
        (Part.WHERE, Relation.NEAREST): "nearest to you; closest to you; nearest to the robot; closest to the robot",
        (Part.WHERE, Relation.FARTHEST): (
            "farthest from you; furthest from you; farthest from the robot; furthest from the robot"
        ),
        (Part.TABLE, ""): (
            "on the table; from the table; off the table; on the desk; from the desk; off the desk; of the table; "
            "of the desk"
        ),
        (Part.NOUN, "cup"): "cup; mug; glass; teacup",
        (Part.NOUN, "box"): "box; block; cube",
        (Part.NOUN, ANYTHING): "thing; object; item; one",
        (Part.NOT, ""): (
            "not; don't; dont; do not; never; no; without; except; but; neither; nor; isn't; is not; won't; cannot; "
            "can't; stop; non"
        ),
        (Part.SEVERAL, ""): (
            "and; or; then; both; all; every; each; two; three; four; five; cups; mugs; glasses; teacups; boxes; "
            "blocks; cubes; things; objects; items; ones; everything; them; those; these"
        ),
        **{(Part.COLOUR, colour): colour for colour in COLOURS},
    }
)
_ENGLISH_OBJECT, _STANDING = "D?[CR]*N[QL]*", "D?[CR]*N[QqL]*"
ENGLISH = Language(
    words=_ENGLISH_WORDS,
    lift=re.compile(f"P*(?:V{_STANDING}|T{_ENGLISH_OBJECT})U?L*P*"),
    give=re.compile(f"P*(?:[HK]M{_STANDING}|[HK]{_STANDING}G|[HK]{_ENGLISH_OBJECT}WG?|K{_ENGLISH_OBJECT})L*P*"),
    names={name: name for name in (*COLOURS, *KINDS, ANYTHING, *Relation)},
    verbs="pick up, lift, grab, take, hand me, give me, bring me",
    example="pick up the red cup",
)

_CHINESE_COLOURS = {
    "red": "红",
    "green": "绿",
    "blue": "蓝",
    "yellow": "黄",
    "orange": "橙",
    "purple": "紫",
    "white": "白",
    "black": "黑",
}
_CHINESE_WORDS = _words(
    {
        (Part.LIFT, ""): (
            "拿起; 拿起来; 抓住; 抓起; 抓起来; 抓取; 抓; 捡起; 捡起来; 拾起; 拾起来; 举起; 举起来; 提起; 提起来; "
            "夹起; 夹起来; 夹住; 夹取; 抬起; 抬起来"
        ),
        (Part.TAKE, ""): "拿; 取",
        (Part.PASS, ""): "递",
        (Part.BRING, ""): "拿给我; 递给我; 交给我; 取给我; 传给我; 拿过来; 递过来; 拿过来给我; 递过来给我; 拿来给我",
        (Part.TO_ME, ""): "给我",
        (Part.POLITE, ""): (
            "请; 请你; 麻烦; 麻烦你; 帮我; 请帮我; 请你帮我; 能不能; 可不可以; 能; 可以; 你能; 你能不能; 你可以; "
            "不好意思; 机器人; 你好; 一下; 吧; 谢谢; 谢谢你; 好吗; 可以吗; 吗"
        ),
        (Part.FROM, ""): "从",
        (Part.OBJECT_FIRST, ""): "把; 将",
        (Part.THE, ""): "那个; 这个; 那只; 这只; 一个; 一只; 个; 只",
        (Part.OF, ""): "的",
        (Part.WHICH, Relation.LEFT): "左边; 左侧; 左面; 最左边; 最左侧; 最左; 左手边; 你左边; 靠左边; 靠左",
        (Part.WHICH, Relation.RIGHT): "右边; 右侧; 右面; 最右边; 最右侧; 最右; 右手边; 你右边; 靠右边; 靠右",
        (Part.WHICH, Relation.NEAREST): "最近; 离你最近; 最靠近你; 离机器人最近; 近",
        (Part.WHICH, Relation.FARTHEST): "最远; 离你最远; 离机器人最远; 远",
        (Part.WHICH, Relation.BIGGEST): "最大; 较大; 大",
        (Part.WHICH, Relation.SMALLEST): "最小; 较小; 小",
        (Part.TABLE, ""): "桌上; 桌子上; 桌面上; 桌上面; 桌子上面",
        (Part.NOUN, "cup"): "杯子; 杯; 水杯; 茶杯; 马克杯; 玻璃杯",
        (Part.NOUN, "box"): "盒子; 盒; 方盒; 方块; 箱子; 箱",
        (Part.NOUN, ANYTHING): "东西; 物体; 物品",
        (Part.NOT, ""): "不; 不要; 不是; 别; 没; 没有; 非; 除; 除了; 勿; 无; 莫; 停",
        (Part.SEVERAL, ""): (
            "和; 与; 或; 或者; 以及; 还有; 跟; 及; 并; 然后; 再; 所有; 全部; 都; 两; 二; 三; 每; 各; 些; 它们"
        ),
        # Tea and shades, whose first character alone would be read as a colour of the object.
        (Part.UNKNOWN, ""): (
            "大红; 大红色; 红茶; 绿茶; 黑茶; 白茶; 黄茶; 红酒; 白酒; 黄酒; 粉红; 粉红色; 橙红; 橙红色; 紫红; 紫红色; "
            "黄绿; 黄绿色; 蓝绿; 蓝绿色"
        ),
        **{(Part.COLOUR, colour): f"{word}; {word}色; {word}颜色" for colour, word in _CHINESE_COLOURS.items()},
    }
)
_CHINESE_OBJECT = "(?:D|[LRC]d?)*N"
CHINESE = Language(
    words=_CHINESE_WORDS,
    lift=re.compile(f"P*(?:FL)?P*(?:[VT]P*{_CHINESE_OBJECT}|B?{_CHINESE_OBJECT}(?:FL)?[VT])P*"),
    give=re.compile(
        f"P*(?:FL)?P*(?:[KG]{_CHINESE_OBJECT}|B?{_CHINESE_OBJECT}(?:FL)?[KG]"
        f"|[TE]P*{_CHINESE_OBJECT}G|G[TE]P*{_CHINESE_OBJECT})P*"
    ),
    names={
        **{colour: f"{word}色" for colour, word in _CHINESE_COLOURS.items()},
        "cup": "杯子",
        "box": "盒子",
        ANYTHING: "东西",
        Relation.LEFT: "左边",
        Relation.RIGHT: "右边",
        Relation.NEAREST: "最近",
        Relation.FARTHEST: "最远",
        Relation.BIGGEST: "最大",
        Relation.SMALLEST: "最小",
    },
    verbs="拿起, 抓住, 拿给我, 递给我, 给我",
    example="拿起红色的杯子",
)
