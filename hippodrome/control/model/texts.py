"""The texts that participants read from Hippodrome itself: one table of names and English texts, and a study's own words.

`{name}` in a text is a place for a number, a time or a name. Scripts and templates of `hippodrome/web/` write `TEXT.start`, and
`TEXT.seconds(5)` for a text with places, with the values in the order of the places in the English text. When a page is
made, `hippodrome/control/participants/texts.py` puts the study's texts there. docs/texts.md lists all texts. Pure.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

PLACE = re.compile(r"\{([a-z]+)\}")
_RIGHT_TO_LEFT = re.compile(
    "acm|afb|aii|apc|ara?|arb|arc|arq|ary|arz|azb|bal|ckb|div|dv|fa|fas|glk|heb?|iw|ji|ks|lki|lrc|mzn|nqo|pbt|per|pes|"
    "pnb|prs|ps|pus|sdh?|skr|snd|syr|ug|uig|urd?|yid?"
)
_SCRIPTS = re.compile("adlm|arab|hebr|mand|nkoo|rohg|samr|syrc|thaa")
"""Languages and scripts that are written from right to left, as in browsers. Tags of other languages can name a script."""
_LANGUAGE = re.compile(
    "[A-Za-z]{2,3}(-[A-Za-z]{4})?(-([A-Za-z]{2}|[0-9]{3}))?(-([A-Za-z0-9]{5,8}|[0-9][A-Za-z0-9]{3}))?"
)
"""Language, script, region, variant. With other tags, such as `zh-cmn` and `en-GB-UK`, the browser's functions raise
RangeError (ECMA-402, section 6.2)."""
LANGUAGE = "language"
"""The name of the entry that holds the language of all texts, as in `<html lang>`, and not a text."""

_PAGES = {
    "language": "en",
    "step": "Step {step} of {steps}",
    "titleStep": "{title} · step {step} of {steps}",
    "studyBy": "A study by {researcher}",
    "continue": "Continue",
    "send": "Send",
    "saved": "Your answers are saved.",
    "sending": "Sending…",
    "stillSending": "Still sending… Please check your connection.",
    "noReply": "Still no reply. Your answers are kept; you can press the button again.",
    "offline": (
        "You seem to be offline. Your answers are kept on this device; press the button again when you are back."
    ),
    "missing": "An answer is missing: “{question}”",
    "lookAgain": "Please look at this answer again: “{question}”",
    "tooLong": "Your answers are too long to be sent. Please tell whoever invited you.",
    "shorten": "Your answers are too long to be sent. Please shorten the answer to “{question}”. Nothing is lost.",
    "shortenBy": (
        "Your answers are too long to be sent. Please shorten the answer to “{question}” by about {characters} "
        "characters. Nothing is lost."
    ),
    "shortenLongest": "Your answers are too long to be sent. Please shorten the longest answer. Nothing is lost.",
    "shortenLongestBy": (
        "Your answers are too long to be sent. Please shorten the longest answer by about {characters} characters. "
        "Nothing is lost."
    ),
    "copy": "Copy",
    "copied": "Copied",
    "wrongOne": "One answer is not right yet.",
    "wrongSome": "{number} answers are not right yet.",
    "tooSoon": "Please take your time: you can go on in {seconds} s.",
    "triesOne": "You have one try left.",
    "triesSome": "You have {number} tries left.",
    "endTitle": "Thank you",
    "endText": "The study ends here for you.",
    "endCode": "Your code:",
    "endLink": "Finish",
}
_WAITING = {
    "waitingForGame": "Waiting for the game",
    "gettingReady": "Your game is getting ready",
    "startingAlone": (
        "We are starting a computer for you alone. You need not do anything: the game appears on this page by itself."
    ),
    "startingTogether": (
        "We are starting a computer for your game. You need not do anything: the game appears on this page by itself."
    ),
    "stageQueued": "Your request has been received",
    "stageStarting": "A computer is starting for you",
    "stageNaming": "The connection is being set up",
    "stageReady": "Ready to play",
    "waiting": "Waiting for {time}.",
    "usually": "Usually it takes about {time}.",
    "takesLonger": "This takes longer than usual. Please stay on this page.",
    "clockWrong": (
        "Your device's clock is wrong, so it cannot connect: it should show {time}. Please set it right; we keep "
        "trying."
    ),
    "noConnection": (
        "No connection – trying again… Your answers are kept. Please stay on this page: it continues by itself. "
        "If this lasts for minutes, try another network, or tell whoever invited you to this study."
    ),
    "needsScript": (
        "The game needs JavaScript, which is switched off in this browser. "
        "Please switch it on, or open your study link in another browser."
    ),
    "movedTitle": "Your game starts on another computer",
    "moved": (
        "The previous computer has failed. This is not your fault. You need not do anything: the game appears on this "
        "page by itself. What you have answered and played before is kept."
    ),
    "movedProgramTitle": "The connection to your game was lost",
    "movedProgram": (
        "Your game goes on on another computer, which takes about a minute to start. Press the button to wait for it."
    ),
    "second": "1 second",
    "seconds": "{seconds} seconds",
    "minutes": "{minutes} min {seconds} s",
}
_ENDED = {
    "endedTitle": "The game has ended",
    "failedTitle": "The game could not be started",
    "lostTitle": "The game could not be played",
    "fullTitle": "The study is full just now",
    "stopped": "The computer for your game was switched off by the researchers.",
    "deadline": "The time for it was over.",
    "idle": "The game was not played for a while, or the time for it was over, so its computer switched itself off.",
    "failed": "The computers that we tried for your game failed, or it could not begin on them. This is not your fault.",
    "refused": "No computer for your game can be started as the study is set up. This is not your fault.",
    "noCapacity": "There is no free computer for your game at the moment. This is not your fault.",
    "full": "All places for this game are taken at the moment. This is not your fault.",
    "computerGone": "Its computer is not there any more.",
    "kept": "What you have answered and played before is kept.",
    "tryLater": "Please try again in a few minutes, here or by opening your link later.",
    "goOnWith": "With “{button}” you go on.",
    "goOnBelow": "With the button below you go on.",
    "without": "You can go on with the study without this game.",
    "withoutOrAgain": "You can go on with the study without this game, or try once more.",
    "goWithoutGame": "Go on without the game",
    "contact": "The researchers can be reached here: {contact}",
    "quote": "If you write to them, please name your id {user} and the code {code}.",
    "tellIfAgain": "If this happens again, please tell whoever invited you to this study.",
    "tell": "Please tell whoever invited you to this study.",
    "tryAgain": "Try again",
    "startAgain": "Start again",
}
_GAME = {
    "game": "Game",
    "score": "Score",
    "picture": "The game's picture",
    "toRead": "To read",
    "loading": "Loading the game…",
    "pictures": "Pictures of the game",
    "loadingPictures": "Loading the pictures…",
    "readyTitle": "Ready – {study}",
    "ready": "Ready?",
    "start": "Start",
    "orArrow": "or press an arrow key",
    "playing": "Playing",
    "pause": "Pause",
    "paused": "Paused",
    "goOn": "Go on",
    "end": "End the game",
    "endConfirm": "End the game now? You cannot go on with it afterwards.",
    "reset": "Begin again",
    "good": "Good",
    "bad": "Bad",
    "trainOnline": "Train online",
    "trainOffline": "Train offline",
    "slower": "Slower",
    "faster": "Faster",
    "speed": "Speed",
    "perSecond": "{rate} per second",
    "up": "Up",
    "left": "Left",
    "right": "Right",
    "down": "Down",
    "space": "Space",
    "keyMove": "move",
    "keyToggle": "start and pause",
    "keyStart": "start",
    "keyPause": "pause and go on",
    "keyReset": "begin again",
    "keyGood": "good",
    "keyBad": "bad",
    "gameOf": "Game {game} of {games}",
    "total": "Total {score}",
    "yourScore": "Your score: {score}",
    "totalScore": "Your total score in {games} games: {score}",
    "getReady": "Get ready",
    "getReadyIn": "Get ready. The game begins in {time}.",
    "timeLeft": "Time left",
    "secondsLeft": "{seconds} seconds left",
    "yourTurn": "Your turn",
    "yourTurnLeft": "Your turn ({seconds} s)",
    "otherTurn": "The other player’s turn",
    "othersTurn": "The others’ turn",
    "youChose": "You chose “{action}”.",
    "timeUp": "Time was up: “{action}” was chosen for you.",
    "timeUpIdle": "Time was up; nothing was chosen for you.",
    "timeUpEnds": "The time for a choice was up, so this game has ended.",
    "gameOver": "Game {game} of {games} is over",
    "nextGameIn": "The next game begins in {time}.",
    "goOnNow": "Go on now",
    "instructions": "Instructions",
    "toGame": "Go to the game",
    "backToGame": "Back to the game",
    "nextGame": "Next game",
    "hangs": "The connection hangs. Please stay on this page.",
    "lost": "Connection lost – trying again…",
    "lostNote": (
        "Your game is kept. Please stay on this page: it continues by itself. "
        "If this lasts for minutes, try another network, or tell whoever invited you to this study."
    ),
    "elsewhere": "The game was opened in another tab or on another device",
    "elsewhereNote": "If you have closed it there, go on here.",
    "playHere": "Play here instead",
    "saving": "Saving your game…",
    "over": "The game is over",
    "thanksForPlaying": "Thank you for playing!",
    "savedMoment": "Your game is saved. One moment, please…",
    "savedOffline": (
        "Your game is saved. No connection – trying again… Please stay on this page: it continues "
        "by itself. If this lasts for minutes, try another network."
    ),
}
_LOBBY = {
    "lobbyTitleOther": "Waiting for another participant",
    "lobbyTitleOthers": "Waiting for other participants",
    "lobbyOther": (
        "Two people play this game together. You need not do anything: the game begins on this page by itself. "
        "Please stay on this page."
    ),
    "lobbyOthers": (
        "{players} people play this game together. You need not do anything: the game begins on this page by itself. "
        "Please stay on this page."
    ),
    "firstOf": "You are the first of {players}",
    "hereWithYou": "{here} of {players} are here, you included",
    "countOf": "{here} of {players}",
    "found": "Found",
    "foundOther": "Found: another participant is here.",
    "foundEnough": "Found: enough participants are here.",
    "moment": "One moment, please…",
    "waited": "You have waited for {time}.",
    "lobbyAway": "You were away for a while, so your waiting time has begun again.",
    "ifNobody": "If nobody else comes in the next {time}, {next}.",
    "ifFew": "If not enough people come in the next {time}, {next}.",
    "nobodyCame": "Nobody else has come, so {next}.",
    "fewCame": "Not enough people have come, so {next}.",
    "goWithout": "you go on to the next part of the study without this game",
    "playComputer": "you play with a computer player instead",
    "beginWithFew": "the game begins with those who are here, and computer players take the empty places",
    "aloneWithOne": "Nobody else has come: you play with a computer player.",
    "aloneWithSome": "Nobody else has come: you play with computer players.",
    "takesPlace": "{here} of {players} are here, you included: a computer player takes the empty place.",
    "takePlaces": "{here} of {players} are here, you included: computer players take the empty places.",
    "preparedTitle": "Your game is being prepared – {study}",
    "prepared": "Your game is being prepared.",
    "preparedHeading": "Your game is being prepared",
    "playWith": "You play with {people}.",
    "playWithBoth": "You play with {people} and {computers}.",
    "oneOther": "another participant",
    "someOthers": "{number} other participants",
    "oneComputer": "a computer player",
    "someComputers": "{number} computer players",
}
_TOGETHER = {
    "you": "You: {name}",
    "player": "Player {number}",
    "reads": "reading",
    "awaited": "not here yet",
    "away": "away",
    "computer": "computer",
    "areHere": "{here} of {players} are here",
    "waitingForOther": "Waiting for the other participant",
    "waitingForOthers": "Waiting for the other participants",
    "waitingForNames": "Waiting for {names}",
    "youWereAway": "You were away for a moment",
    "begins": "The game begins",
    "goesOn": "The game goes on",
    "beginsWithAll": "The game begins as soon as everybody is here.",
    "goesOnWithAll": "The game goes on as soon as everybody is here.",
    "theyRead": "They have not gone on yet. The game begins in {time} at the latest.",
    "absentEnds": "If they are not here in {time}, the game ends for everybody.",
    "absentReplaced": "If they are not here in {time}, a computer player takes their place.",
    "otherWaits": "The other participant waits for you. Please go on within {time}.",
    "othersWait": "The other participants wait for you. Please go on within {time}.",
    "otherReplaced": "A computer player has taken the place of the other participant.",
    "replaced": "A computer player has taken the place of {name}.",
    "otherBack": "The other participant is back.",
    "back": "{name} is back.",
    "theirTurn": "{names}: their turn",
    "otherSees": (
        "The other participant can see that you are away, and the game waits for a short while. "
        "What you have played is kept. Please stay on this page. If this lasts, try another network."
    ),
    "othersSee": (
        "The other participants can see that you are away, and the game waits for a short while. "
        "What you have played is kept. Please stay on this page. If this lasts, try another network."
    ),
    "endForAll": "End the game for everybody",
    "hasEnded": "The game has ended",
    "thanks": "Thank you!",
    "youLeft": "You were away for too long, so the game has ended. What you have played is kept. Please go on.",
    "otherLeft": (
        "The other participant is not there any more, so the game has ended. This is not your fault. Please go on."
    ),
    "someLeft": "A participant is not there any more, so the game has ended. This is not your fault. Please go on.",
    "tooSlow": "Your connection to the game is too slow to play with others. This is not your fault. Please go on.",
}
_TALK = {
    "messages": "Messages",
    "writeMessage": "Write a message",
    "sendMessage": "Send",
    "yourMessage": "You:",
    "ai": "AI",
    "isTyping": "{name} is typing…",
    "areTyping": "{names} are typing…",
    "writesNext": "{name} writes next.",
    "newMessages": "New messages",
    "charactersLeft": "{number} characters left",
    "charactersOver": "{number} characters too many",
    "messageTooLong": "Your message is too long: it may have {number} characters.",
    "tooManyMessages": "You are writing faster than your messages can be sent. Please wait a moment.",
    "messageKept": "No connection. Your message is kept, and sent as soon as there is one.",
    "messageHeld": "Your message was not passed on.",
    "messageRefused": "Your message could not be sent. Please try again.",
    "talkTitle": "Conversation",
    "talkWaiting": "Waiting for the conversation",
    "talkGettingReady": "Your conversation is getting ready",
    "talkStartingAlone": (
        "We are starting a computer for you alone. You need not do anything: the conversation appears on this page by "
        "itself."
    ),
    "talkStartingTogether": (
        "We are starting a computer for your conversation. You need not do anything: the conversation appears on this "
        "page by itself."
    ),
    "talkLoading": "Loading the conversation…",
    "talkEnd": "End the conversation",
    "talkEndConfirm": "End the conversation now? You cannot go on with it afterwards.",
    "talkEndForAll": "End the conversation for everybody",
    "endRound": "End this round",
    "roundOf": "Round {game} of {games}",
    "roundOver": "Round {game} of {games} is over",
    "nextRoundIn": "The next round begins in {time}.",
    "nextRound": "Next round",
    "toTalk": "Go to the conversation",
    "backToTalk": "Back to the conversation",
    "talkSaving": "Saving your conversation…",
    "talkOver": "The conversation is over",
    "thanksForTalking": "Thank you for taking part!",
    "talkSaved": "Your conversation is saved. One moment, please…",
    "talkBegins": "The conversation begins",
    "talkGoesOn": "The conversation goes on",
    "talkLobbyOther": (
        "Two people talk with each other. You need not do anything: the conversation begins on this page by itself. "
        "Please stay on this page."
    ),
    "talkLobbyOthers": (
        "{players} people talk with each other. You need not do anything: the conversation begins on this page by "
        "itself. Please stay on this page."
    ),
    "talkPreparedTitle": "Your conversation is being prepared – {study}",
    "talkPrepared": "Your conversation is being prepared.",
    "talkPreparedHeading": "Your conversation is being prepared",
    "talkWith": "You talk with {people}.",
    "talkEnded": "The conversation has ended",
}
IN_TALK = {
    "game": "talkTitle",
    "waitingForGame": "talkWaiting",
    "gettingReady": "talkGettingReady",
    "startingAlone": "talkStartingAlone",
    "startingTogether": "talkStartingTogether",
    "loading": "talkLoading",
    "end": "talkEnd",
    "endConfirm": "talkEndConfirm",
    "endForAll": "talkEndForAll",
    "reset": "endRound",
    "gameOf": "roundOf",
    "gameOver": "roundOver",
    "nextGameIn": "nextRoundIn",
    "nextGame": "nextRound",
    "toGame": "toTalk",
    "backToGame": "backToTalk",
    "saving": "talkSaving",
    "over": "talkOver",
    "thanksForPlaying": "thanksForTalking",
    "savedMoment": "talkSaved",
    "begins": "talkBegins",
    "goesOn": "talkGoesOn",
    "lobbyOther": "talkLobbyOther",
    "lobbyOthers": "talkLobbyOthers",
    "preparedTitle": "talkPreparedTitle",
    "prepared": "talkPrepared",
    "preparedHeading": "talkPreparedHeading",
    "playWith": "talkWith",
    "hasEnded": "talkEnded",
}
"""By the name of a text on the page of a game: that of the text that stands there if the game is `talk`."""
NOT_IN_TALK = ("yourScore", "totalScore", "orArrow")
"""Texts that say nothing if the game is `talk`, which has neither scores nor arrows."""
SAID_ALONE = {
    "saidRoundFailed": "Something went wrong, so this game has ended. The next game begins.",
    "saidRoundAgain": "This game could not go on where it was, so it begins again. The games before it are kept.",
    "saidGameFailed": ("Something went wrong, so the game ends here. What you have played is kept."),
}
SAID_TOGETHER = {
    "saidPartnerLeft": (
        "Another participant has gone and has not come back, so the game ends here for all. "
        "That is not your fault, and what you have played is kept. Please continue."
    ),
    "saidPartnerStopped": (
        "Another participant has ended the game, so it ends here for all. "
        "That is not your fault, and what you have played is kept. Please continue."
    ),
    "saidPartnerMissing": (
        "Another participant has not come, so the game cannot be played together. "
        "That is not your fault. Please continue."
    ),
    "saidLeft": (
        "You were away for longer than the others could wait, so the game has ended for all. "
        "What you have played is kept. Please continue."
    ),
    "saidPing": (
        "Your connection to the game is too slow for a game with others. That is not your fault: "
        "it may be far from here, or shared with many. Please continue."
    ),
}
SAID = SAID_ALONE | SAID_TOGETHER
"""The sentences that servers send, in English (`hippodrome/trial/core/`). The page replaces them with the study's own words."""
_LINKS = {
    "studyFull": "This study is full",
    "studyFullText": (
        "All places are taken, and nothing has been kept of your visit. Thank you for your interest! "
        "Now and then a place becomes free: you are welcome to come back later with the same link."
    ),
    "notSaved": "Your answers were not saved",
    "notSavedText": "{why} Nothing is lost: go back.",
    "formUnread": "What your browser sent could not be read.",
    "formTooLong": "Your answers are too long to be sent: 256 KB is the most. Please shorten them.",
    "outdated": "This page is out of date",
    "outdatedText": "Please open your study link again.",
    "whoAreYou": "Who are you?",
    "whoAreYouText": "The link lacks its userId. Please open your study link again.",
    "brokenLink": "This link is broken",
    "brokenLinkText": "Please copy the whole link again from your invitation.",
    "brokenId": "Its {field} should be 1 to 64 letters, digits, dashes or underscores.",
    "byInvitation": "This study is by invitation",
    "byInvitationText": "It needs the link of your own invitation. Please copy the whole link again from there.",
    "pageMissing": "This page is missing",
    "pageMissingText": "It was not uploaded. Please tell whoever invited you.",
    "pageBroken": "This page is broken",
    "pageBrokenText": "It could not be shown. Please tell whoever invited you.",
    "aStudy": "A study",
    "preview": "This is a preview. Once you have accepted the task, the study opens here.",
    "openInBrowser": "Open the link in a browser to take part.",
}

GROUPS: Mapping[str, Mapping[str, str]] = {
    "Pages and forms": _PAGES,
    "Waiting for the game": _WAITING,
    "When the game cannot be played": _ENDED,
    "The game": _GAME,
    "The lobby": _LOBBY,
    "Playing with others": _TOGETHER,
    "Talk": _TALK,
    "What the game's server says": SAID,
    "Links and errors": _LINKS,
}
"""The English texts by their names, in the order of docs/texts.md."""
ENGLISH: Mapping[str, str] = {name: text for group in GROUPS.values() for name, text in group.items()}


def is_language(text: str) -> bool:
    """Return whether pages and scripts can use this text as the tag of a language, such as `de` or `pt-BR`."""
    return _LANGUAGE.fullmatch(text) is not None


def is_right_to_left(language: str) -> bool:
    """Return whether the language with this tag is written from right to left.

    If the tag names a script (`ku-Arab`), the script decides.
    """
    name, script, *_ = [*language.lower().split("-"), ""]
    by_script = len(script) == 4 and script.isalpha()
    return bool(_SCRIPTS.fullmatch(script) if by_script else _RIGHT_TO_LEFT.fullmatch(name))


def texts_of(*, has_game: bool, has_sessions: bool, has_chat: bool = False) -> list[str]:
    """Return the names of the texts that participants may read in a study with or without a game, sessions and talk."""
    groups = [_PAGES, _LINKS]
    groups += [_WAITING, _ENDED, _GAME, SAID_ALONE] if has_game else []
    groups += [_LOBBY, _TOGETHER, SAID_TOGETHER] if has_sessions else []
    groups += [_TALK] if has_chat else []
    return [name for name in ENGLISH if any(name in group for group in groups)]


def places(text: str) -> tuple[str, ...]:
    """Return the names of the placeholders in a text, such as `seconds`: each once, in the order of the text."""
    return tuple(dict.fromkeys(PLACE.findall(text)))


class Texts:
    """The texts of one study: its own words, and the English text for any other name.

    Two objects are equal if their own words are equal.
    """

    __slots__ = ("_hash", "_own")

    def __init__(self, own: Mapping[str, str]) -> None:
        self._own = {name: text for name, text in own.items() if text and name in ENGLISH}
        # Computed once, since each template and script of a page asks for it.
        self._hash = hash(frozenset(self._own.items()))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Texts) and self._own == other._own

    def __hash__(self) -> int:
        return self._hash

    def __getitem__(self, name: str) -> str:
        return self._own.get(name, ENGLISH[name])

    @property
    def language(self) -> str:
        """The tag of the language of these texts."""
        return self[LANGUAGE]

    def all(self) -> dict[str, str]:
        """Return all texts by their names."""
        return {**ENGLISH, **self._own}

    def say(self, name: str, /, **values: Any) -> str:
        """Return the text with these values in its placeholders. A placeholder without a value stays as it is."""
        return PLACE.sub(lambda place: str(values.get(place[1], place[0])), self[name])

    def in_talk(self) -> Texts:
        """Return the texts of a page whose game is `talk`: its words for a round and a conversation."""
        said = {name: self._own.get(own) or self._own.get(name) or ENGLISH[own] for name, own in IN_TALK.items()}
        texts = Texts({})
        texts._own = self._own | said | dict.fromkeys(NOT_IN_TALK, "")
        texts._hash = hash(frozenset(texts._own.items()))
        return texts

    def of_server(self) -> dict[str, str]:
        """Return the study's own words for sentences of servers, by the English sentence. Sentences without own words
        are left out.
        """
        return {ENGLISH[name]: self[name] for name in SAID if self[name] != ENGLISH[name]}


IN_ENGLISH = Texts({})
