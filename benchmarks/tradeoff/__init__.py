"""`jaxrod tradeoff`: error against cost, PyElastica and MuJoCo's cable beside it."""
