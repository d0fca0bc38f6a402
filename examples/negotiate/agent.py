"""Tells each participant in private who they are, and both what was offered after each round."""

ROLES = {
    "buyer": "You are the buyer. The bicycle is worth 100 to you: your gain is 100 minus the price, or nothing.",
    "seller": "You are the seller. The bicycle is worth 60 to you: your gain is the price minus 60, or nothing.",
}


class Agent:
    """The game `talk` needs no other methods."""

    def __init__(self):
        self.offers = {}

    def on_episode_start(self, session):
        """Say in private who each participant is."""
        for player in session.players if session.episode == 1 else ():
            if player in ROLES:
                session.say(ROLES[player], to=player)

    def on_form(self, session, player, fields):
        """Note an offer of the page between two rounds. Tell both, once both are there."""
        if "price" not in fields or player not in ROLES:
            return
        self.offers[player] = fields["price"]
        if len(self.offers) == len(ROLES):
            session.record("offers", dict(self.offers))
            session.say(f"The buyer offers {self.offers['buyer']}, and the seller asks for {self.offers['seller']}.")
            self.offers = {}
