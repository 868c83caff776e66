"""The arm as mathematics: model, batched chain, Jacobians, static wrenches."""
