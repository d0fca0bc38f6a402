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
    "saved": "Your answers have been saved.",
    "sending": "Sending…",
    "stillSending": "Still sending… Please check your connection.",
    "noReply": "The server has not replied yet. Your answers are still here; you can press the button again.",
    "offline": (
        "You appear to be offline. Your answers are kept on this device. Press the button again when you are back "
        "online."
    ),
    "missing": "Please answer this question: “{question}”",
    "answerHere": "Please answer this question.",
    "lookAgain": "Please check your answer to “{question}”",
    "tooLong": "Your answers are too long to send. Please contact the researchers who invited you.",
    "shorten": "Your answers are too long to send. Please shorten your answer to “{question}”. Nothing has been lost.",
    "shortenBy": (
        "Your answers are too long to send. Please shorten your answer to “{question}” by about {characters} "
        "characters. Nothing has been lost."
    ),
    "shortenLongest": "Your answers are too long to send. Please shorten your longest answer. Nothing has been lost.",
    "shortenLongestBy": (
        "Your answers are too long to send. Please shorten your longest answer by about {characters} characters. "
        "Nothing has been lost."
    ),
    "copy": "Copy",
    "copied": "Copied",
    "wrongOne": "One answer is not correct yet.",
    "wrongSome": "{number} answers are not correct yet.",
    "tooSoon": "Please take your time. You can continue in {seconds} s.",
    "opensAt": "You can continue from {time}.",
    "triesOne": "You have one attempt left.",
    "triesSome": "You have {number} attempts left.",
    "endTitle": "Thank you",
    "endText": "Your part in the study ends here.",
    "endCode": "Your code:",
    "endLink": "Finish",
}
_WAITING = {
    "waitingForGame": "Waiting for the game",
    "gettingReady": "Preparing your game",
    "startingAlone": ("We are getting your game ready. Please wait: the game will appear on this page automatically."),
    "startingTogether": (
        "We are starting the server for your game. Please wait: the game will appear on this page automatically."
    ),
    "stageQueued": "Request received",
    "stageStarting": "Starting your game server",
    "stageNaming": "Setting up the connection",
    "stageReady": "Ready to play",
    "waiting": "Waiting time: {time}.",
    "usually": "This usually takes about {time}.",
    "takesLonger": "This is taking longer than usual. Please stay on this page.",
    "clockWrong": (
        "Your device’s clock is wrong, so your browser cannot connect. It should show {time}. Please correct it; we "
        "will keep trying."
    ),
    "noConnection": (
        "No connection. Trying again… Your answers are safe. Please stay on this page; it will continue "
        "automatically. If this takes more than a few minutes, try Wi-Fi or mobile data, or "
        "contact the researchers who invited you."
    ),
    "needsScript": (
        "The game needs JavaScript, which is turned off in this browser. Please turn it on, or open your study "
        "link in another browser."
    ),
    "movedTitle": "Your game is moving to another server",
    "moved": (
        "The previous server stopped working. This is not your fault. Please wait: the game will appear on this "
        "page automatically. Your earlier answers and games are saved."
    ),
    "movedProgramTitle": "The connection to your game was lost",
    "movedProgram": (
        "Your game will continue on another server, which takes about a minute to start. Press the button to wait "
        "for it."
    ),
    "second": "1 second",
    "seconds": "{seconds} seconds",
    "minutes": "{minutes} min {seconds} s",
}
_ENDED = {
    "endedTitle": "The game has ended",
    "failedTitle": "The game could not start",
    "lostTitle": "The game could not be played",
    "fullTitle": "The study is full right now",
    "stopped": "The researchers ended your game.",
    "deadline": "The time limit was reached.",
    "idle": "The game was inactive for too long, or its time limit was reached, so it was closed.",
    "failed": "The game did not work on any of the servers we tried. This is not your fault.",
    "refused": "Your game cannot start because of a problem with the study’s setup. This is not your fault.",
    "noCapacity": "No server is available for your game right now. This is not your fault.",
    "full": "All places in this game are taken right now. This is not your fault.",
    "computerGone": "The game server has stopped.",
    "kept": "Your earlier answers and games are saved.",
    "tryLater": "Please try again in a few minutes, here or with your study link.",
    "goOnWith": "Press “{button}” to continue.",
    "goOnBelow": "Press the button below to continue.",
    "without": "You can continue the study without this game.",
    "withoutOrAgain": "You can continue the study without this game, or try the game again.",
    "goWithoutGame": "Continue without the game",
    "contact": "You can contact the researchers here: {contact}",
    "quote": "If you write to them, please include your ID {user} and the code {code}.",
    "tellIfAgain": "If this happens again, please contact the researchers who invited you.",
    "tell": "Please contact the researchers who invited you.",
    "tryAgain": "Try again",
    "startAgain": "Start again",
}
_GAME = {
    "game": "Game",
    "score": "Score",
    "picture": "Game picture",
    "toRead": "To read",
    "loading": "Loading the game…",
    "loadingNote": "This takes a few seconds.",
    "pictures": "Pictures of the game",
    "loadingPictures": "Loading the pictures…",
    "readyTitle": "Ready – {study}",
    "ready": "Ready?",
    "start": "Start",
    "orArrow": "or press an arrow key",
    "playing": "Playing",
    "pause": "Pause",
    "paused": "Paused",
    "goOn": "Resume",
    "end": "End the game",
    "endConfirm": "End the game now? You will not be able to return to it.",
    "reset": "Restart",
    "good": "Good",
    "bad": "Bad",
    "trainOnline": "Train online",
    "trainOffline": "Train offline",
    "slower": "Slower",
    "faster": "Faster",
    "speed": "Speed",
    "perSecond": "{rate} frames per second",
    "up": "Up",
    "left": "Left",
    "right": "Right",
    "down": "Down",
    "space": "Space",
    "keyMove": "move",
    "keyToggle": "start or pause",
    "keyStart": "start",
    "keyPause": "pause or resume",
    "keyReset": "restart",
    "keyGood": "good",
    "keyBad": "bad",
    "gameOf": "Game {game} of {games}",
    "total": "Total {score}",
    "yourScore": "Your score: {score}",
    "totalScore": "Your total score in {games} games: {score}",
    "getReady": "Get ready",
    "getReadyIn": "Get ready. The game starts in {time}.",
    "timeLeft": "Time left",
    "secondsLeft": "{seconds} seconds left",
    "yourTurn": "Your turn",
    "yourTurnLeft": "Your turn ({seconds} s)",
    "otherTurn": "The other player’s turn",
    "othersTurn": "The others’ turn",
    "youChose": "You chose “{action}”.",
    "timeUp": "Time ran out, so “{action}” was chosen for you.",
    "timeUpIdle": "Time ran out before you made a choice.",
    "timeUpEnds": "Time ran out, so this game has ended.",
    "gameOver": "Game {game} of {games} is over",
    "nextGameIn": "The next game starts in {time}.",
    "goOnNow": "Continue now",
    "instructions": "Instructions",
    "toGame": "Go to the game",
    "backToGame": "Back to the game",
    "nextGame": "Next game",
    "hangs": "Your connection is slow. Please stay on this page.",
    "lost": "Connection lost. Trying again…",
    "lostNote": (
        "Your game is safe. Please stay on this page; it will continue automatically. If this takes more than a "
        "few minutes, try Wi-Fi or mobile data, or contact the researchers who invited you."
    ),
    "elsewhere": "The game is open in another tab or on another device",
    "elsewhereNote": "If you have closed it there, continue here.",
    "playHere": "Play here instead",
    "saving": "Saving your game…",
    "over": "The game is over",
    "thanksForPlaying": "Thank you for playing!",
    "savedMoment": "Your game is saved. Just a moment…",
    "savedOffline": (
        "Your game is saved. No connection. Trying again… Please stay on this page; it will continue "
        "automatically. If this takes more than a few minutes, try Wi-Fi or mobile data."
    ),
}
_LOBBY = {
    "lobbyTitleOther": "Waiting for another participant",
    "lobbyTitleOthers": "Waiting for other participants",
    "lobbyOther": "This is a game for two people. Please stay on this page: the game will start automatically.",
    "lobbyOthers": "This is a game for {players} people. Please stay on this page: the game will start automatically.",
    "firstOf": "You are the first of {players} people",
    "hereWithYou": "{here} of {players} people are here, including you",
    "countOf": "{here} of {players}",
    "found": "Match found",
    "foundOther": "Another participant is here.",
    "foundEnough": "Enough participants are here.",
    "moment": "Just a moment…",
    "waited": "Waiting time: {time}.",
    "lobbyAway": "You were away for a while, so your waiting time has restarted.",
    "ifNobody": "If nobody else joins within {time}, {next}.",
    "ifFew": "If not enough people join within {time}, {next}.",
    "nobodyCame": "Nobody else joined, so {next}.",
    "fewCame": "Not enough people joined, so {next}.",
    "goWithout": "you will continue without this game",
    "playComputer": "you will play with a computer player instead",
    "beginWithFew": "the game will start with those who are here, and computer players will fill the empty places",
    "aloneWithOne": "Nobody else joined, so you will play with a computer player.",
    "aloneWithSome": "Nobody else joined, so you will play with computer players.",
    "takesPlace": "{here} of {players} people are here, including you. A computer player will fill the empty place.",
    "takePlaces": "{here} of {players} people are here, including you. Computer players will fill the empty places.",
    "preparedTitle": "Your game is being prepared – {study}",
    "prepared": "Your game is being prepared.",
    "preparedHeading": "Your game is being prepared",
    "playWith": "You will play with {people}.",
    "playWithBoth": "You will play with {people} and {computers}.",
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
    "begins": "The game is starting",
    "goesOn": "The game is about to continue",
    "beginsWithAll": "The game will start as soon as everyone is here.",
    "goesOnWithAll": "The game will continue as soon as everyone is here.",
    "theyRead": "Not everyone has finished reading. The game will start within {time}.",
    "absentEnds": "If they are not here within {time}, the game will end for everyone.",
    "absentReplaced": "If they are not here within {time}, a computer player will take their place.",
    "otherWaits": "The other participant is waiting for you. Please continue within {time}.",
    "othersWait": "The other participants are waiting for you. Please continue within {time}.",
    "otherReplaced": "A computer player has replaced the other participant.",
    "replaced": "A computer player has replaced {name}.",
    "otherBack": "The other participant is back.",
    "back": "{name} is back.",
    "theirTurn": "Turn: {names}",
    "otherSees": (
        "The other participant can see that you are away, and the game will wait for a short time. Everything so "
        "far is saved. Please stay on this page. If this takes long, try Wi-Fi or mobile data."
    ),
    "othersSee": (
        "The other participants can see that you are away, and the game will wait for a short time. Everything so "
        "far is saved. Please stay on this page. If this takes long, try Wi-Fi or mobile data."
    ),
    "endForAll": "End the game for everyone",
    "hasEnded": "The game has ended",
    "thanks": "Thank you!",
    "youLeft": (
        "You were away for too long, so the game has ended. Everything so far is saved. Please continue with the study."
    ),
    "otherLeft": (
        "The other participant left, so the game has ended. This is not your fault. Please continue with the study."
    ),
    "someLeft": (
        "Another participant left, so the game has ended. This is not your fault. Please continue with the study."
    ),
    "tooSlow": (
        "Your connection is too slow to play with others. This is not your fault. Please continue with the study."
    ),
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
    "messageTooLong": "Your message is too long. The limit is {number} characters.",
    "tooManyMessages": "You are sending messages too quickly. Please wait a moment.",
    "messageKept": "No connection. Your message is saved here and will be sent when the connection is back.",
    "messageHeld": "Your message was not delivered.",
    "messageRefused": "Your message could not be sent. Please try again.",
    "talkTitle": "Conversation",
    "talkWaiting": "Waiting for the conversation",
    "talkGettingReady": "Preparing your conversation",
    "talkStartingAlone": (
        "We are getting your conversation ready. Please wait: the conversation will appear on this page automatically."
    ),
    "talkStartingTogether": (
        "We are starting the server for your conversation. Please wait: the conversation will appear on this "
        "page automatically."
    ),
    "talkLoading": "Loading the conversation…",
    "talkEnd": "End the conversation",
    "talkEndConfirm": "End the conversation now? You will not be able to return to it.",
    "talkEndForAll": "End the conversation for everyone",
    "endRound": "End this round",
    "roundOf": "Round {game} of {games}",
    "roundOver": "Round {game} of {games} is over",
    "nextRoundIn": "The next round starts in {time}.",
    "nextRound": "Next round",
    "toTalk": "Go to the conversation",
    "backToTalk": "Back to the conversation",
    "talkSaving": "Saving your conversation…",
    "talkOver": "The conversation is over",
    "thanksForTalking": "Thank you for taking part!",
    "talkSaved": "Your conversation is saved. Just a moment…",
    "talkBegins": "The conversation is starting",
    "talkGoesOn": "The conversation is about to continue",
    "talkLobbyOther": (
        "This is a conversation between two people. Please stay on this page: it will start automatically."
    ),
    "talkLobbyOthers": (
        "This is a conversation between {players} people. Please stay on this page: it will start automatically."
    ),
    "talkPreparedTitle": "Your conversation is being prepared – {study}",
    "talkPrepared": "Your conversation is being prepared.",
    "talkPreparedHeading": "Your conversation is being prepared",
    "talkWith": "You talk with {people}.",
    "talkEnded": "The conversation has ended",
    "talkElsewhere": "The conversation is open in another tab or on another device",
    "talkLost": (
        "Your conversation is safe. Please stay on this page; it will continue automatically. If this takes more "
        "than a few minutes, try Wi-Fi or mobile data, or contact the researchers who invited "
        "you."
    ),
    "talkBeginsWithAll": "The conversation will start as soon as everyone is here.",
    "talkGoesOnWithAll": "The conversation will continue as soon as everyone is here.",
    "talkTheyRead": "Not everyone has finished reading. The conversation will start within {time}.",
    "talkAbsentEnds": "If they are not here within {time}, the conversation will end for everyone.",
    "talkOtherSees": (
        "The other participant can see that you are away, and will wait for a short time. Everything so far is "
        "saved. Please stay on this page. If this takes long, try Wi-Fi or mobile data."
    ),
    "talkOthersSee": (
        "The other participants can see that you are away, and will wait for a short time. Everything so far is "
        "saved. Please stay on this page. If this takes long, try Wi-Fi or mobile data."
    ),
    "talkYouLeft": (
        "You were away for too long, so the conversation has ended. Everything so far is saved. Please continue "
        "with the study."
    ),
    "talkOtherLeft": (
        "The other participant left, so the conversation has ended. This is not your fault. Please continue "
        "with the study."
    ),
    "talkSomeLeft": (
        "Another participant left, so the conversation has ended. This is not your fault. Please continue "
        "with the study."
    ),
    "talkSavedOffline": (
        "Your conversation is saved. No connection. Trying again… Please stay on this page; it will continue "
        "automatically. If this takes more than a few minutes, try Wi-Fi or mobile data."
    ),
    "talkStageStarting": "Starting your server",
    "talkStageReady": "Ready",
    "talkMovedTitle": "Your conversation is moving to another server",
    "talkMoved": (
        "The previous server stopped working. This is not your fault. Please wait: the conversation will appear "
        "on this page automatically. Your earlier answers are saved."
    ),
    "talkNeedsScript": (
        "The conversation needs JavaScript, which is turned off in this browser. Please turn it on, or open your "
        "study link in another browser."
    ),
    "talkFailed": "The conversation could not start",
    "talkNotHeld": "The conversation could not take place",
    "talkStopped": "The researchers ended your conversation.",
    "talkIdle": "The conversation was inactive for too long, or its time limit was reached, so it was closed.",
    "talkNoServer": "The conversation did not work on any of the servers we tried. This is not your fault.",
    "talkNotSetUp": (
        "Your conversation cannot start because of a problem with the study’s setup. This is not your fault."
    ),
    "talkNoCapacity": "No server is available for your conversation right now. This is not your fault.",
    "talkFull": "All places in this conversation are taken right now. This is not your fault.",
    "talkServerGone": "The server has stopped.",
    "talkKept": "Your earlier answers are saved.",
    "talkWithout": "You can continue the study without this conversation.",
    "talkWithoutOrAgain": "You can continue the study without this conversation, or try it again.",
    "talkSkip": "Continue without the conversation",
    "talkHere": "Continue here instead",
    "talkGetReadyIn": "Get ready. The conversation starts in {time}.",
    "talkGoWithout": "you will continue without this conversation",
    "talkTooSlow": "Your connection is too slow to take part. This is not your fault. Please continue with the study.",
    "talkRoundFailed": "Something went wrong, so this round has ended. You will continue with the next round.",
    "talkRoundAgain": (
        "This round could not be resumed, so it starts again from the beginning. Your earlier rounds are saved."
    ),
    "talkBroken": "Something went wrong, so the conversation ends here. Everything so far is saved.",
    "talkPartnerLeft": (
        "Another participant left, so the conversation has ended for everyone. This is not your fault. Everything "
        "so far is saved. Please continue with the study."
    ),
    "talkPartnerStopped": (
        "Another participant ended the conversation, so it is over for everyone. This is not your fault. "
        "Everything so far is saved. Please continue with the study."
    ),
    "talkPartnerMissing": (
        "Another participant did not join, so the conversation cannot take place. This is not your fault. Please "
        "continue with the study."
    ),
    "talkLeft": (
        "You were away for too long, so the conversation has ended for everyone. Everything so far is saved. "
        "Please continue with the study."
    ),
    "talkPing": (
        "Your connection is too slow to take part. This is not your fault: the server may be far away, or others "
        "may be using your network. Please continue with the study."
    ),
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
    "elsewhere": "talkElsewhere",
    "lostNote": "talkLost",
    "beginsWithAll": "talkBeginsWithAll",
    "goesOnWithAll": "talkGoesOnWithAll",
    "theyRead": "talkTheyRead",
    "absentEnds": "talkAbsentEnds",
    "otherSees": "talkOtherSees",
    "othersSee": "talkOthersSee",
    "youLeft": "talkYouLeft",
    "otherLeft": "talkOtherLeft",
    "someLeft": "talkSomeLeft",
    "savedOffline": "talkSavedOffline",
    "stageStarting": "talkStageStarting",
    "stageReady": "talkStageReady",
    "movedTitle": "talkMovedTitle",
    "moved": "talkMoved",
    "needsScript": "talkNeedsScript",
    "failedTitle": "talkFailed",
    "lostTitle": "talkNotHeld",
    "stopped": "talkStopped",
    "idle": "talkIdle",
    "failed": "talkNoServer",
    "refused": "talkNotSetUp",
    "noCapacity": "talkNoCapacity",
    "full": "talkFull",
    "computerGone": "talkServerGone",
    "kept": "talkKept",
    "without": "talkWithout",
    "withoutOrAgain": "talkWithoutOrAgain",
    "goWithoutGame": "talkSkip",
    "playHere": "talkHere",
    "getReadyIn": "talkGetReadyIn",
    "goWithout": "talkGoWithout",
    "tooSlow": "talkTooSlow",
    "saidRoundFailed": "talkRoundFailed",
    "saidRoundAgain": "talkRoundAgain",
    "saidGameFailed": "talkBroken",
    "saidPartnerLeft": "talkPartnerLeft",
    "saidPartnerStopped": "talkPartnerStopped",
    "saidPartnerMissing": "talkPartnerMissing",
    "saidLeft": "talkLeft",
    "saidPing": "talkPing",
    "endedTitle": "talkEnded",
    "playing": "talkTitle",
}
"""By the name of a text on the page of a game: that of the text that stands there if the game is `talk`."""
NOT_IN_TALK = ("yourScore", "totalScore", "orArrow")
"""Texts that say nothing if the game is `talk`, which has neither scores nor arrows."""
SAID_ALONE = {
    "saidRoundFailed": "Something went wrong, so this game has ended. You will continue with the next game.",
    "saidRoundAgain": (
        "This game could not be resumed, so it starts again from the beginning. Your earlier games are saved."
    ),
    "saidGameFailed": "Something went wrong, so the game ends here. Everything so far is saved.",
}
SAID_TOGETHER = {
    "saidPartnerLeft": (
        "Another participant left, so the game has ended for everyone. This is not your fault. Everything so far "
        "is saved. Please continue with the study."
    ),
    "saidPartnerStopped": (
        "Another participant ended the game, so it is over for everyone. This is not your fault. Everything so far "
        "is saved. Please continue with the study."
    ),
    "saidPartnerMissing": (
        "Another participant did not join, so the game cannot be played. This is not your fault. Please continue "
        "with the study."
    ),
    "saidLeft": (
        "You were away for too long, so the game has ended for everyone. Everything so far is saved. Please "
        "continue with the study."
    ),
    "saidPing": (
        "Your connection is too slow to play with others. This is not your fault: the game server may be far "
        "away, or others may be using your network. Please continue with the study."
    ),
}
SAID = SAID_ALONE | SAID_TOGETHER
"""The sentences that servers send, in English (`hippodrome/trial/core/`). The page replaces them with the study's own words."""
_LINKS = {
    "studyFull": "This study is full",
    "studyFullText": (
        "All places are taken, and nothing about your visit has been saved. Thank you for your interest! A place "
        "may become free: you are welcome to try the same link again later."
    ),
    "notSaved": "Your answers were not saved",
    "notSavedText": "{why} Go back and try again; your answers are still there.",
    "formUnread": "We could not read what your browser sent.",
    "formTooLong": "Your answers are too long to send (the limit is 256 KB). Please shorten them.",
    "outdated": "This page is out of date",
    "outdatedText": "Please open your study link again.",
    "whoAreYou": "This link is incomplete",
    "whoAreYouText": "Your participant ID (userId) is missing from the link. Please open your study link again.",
    "brokenLink": "This link does not work",
    "brokenLinkText": "Please copy the whole link from your invitation and open it in your browser.",
    "brokenId": "Its {field} must be 1 to 64 letters, digits, hyphens or underscores.",
    "byInvitation": "This study is by invitation only",
    "byInvitationText": (
        "You need your personal link. Please copy the whole link from your invitation and open it in your browser."
    ),
    "pageMissing": "This page is missing",
    "pageMissingText": "It was not uploaded. Please contact the researchers who invited you.",
    "pageBroken": "This page cannot be shown",
    "pageBrokenText": "It contains an error. Please contact the researchers who invited you.",
    "aStudy": "A study",
    "preview": "This is a preview. The study will open here once you accept the task.",
    "openInBrowser": "Please open the link in a browser to take part.",
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
        words = {name: self._own.get(own) or self._own.get(name) or ENGLISH[own] for name, own in IN_TALK.items()}
        texts = Texts({})
        texts._own = self._own | words | dict.fromkeys(NOT_IN_TALK, "")
        texts._hash = hash(frozenset(texts._own.items()))
        return texts

    def of_server(self) -> dict[str, str]:
        """Return the study's own words for sentences of servers, by the English sentence. Sentences without own words
        are left out.
        """
        return {ENGLISH[name]: self[name] for name in SAID if self[name] != ENGLISH[name]}


IN_ENGLISH = Texts({})
