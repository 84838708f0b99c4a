"""Check off-policy estimators on a finite MDP whose value is the solution of a linear system."""

from dataclasses import replace

import numpy as np
import pytest

from restock.train.dqn.fitted_q import (
    FittedQConfig,
    Transitions,
    cloned_behaviour,
    fitted_q,
    values,
)
from restock.train.evaluation.ope import (
    EssGate,
    OpeEpisodes,
    effective_episodes,
    estimate,
    observed,
    once,
    per_decision,
)

STATES, ACTIONS, STEPS, DISCOUNT = 5, 2, 30, 0.9


class Chain:
    """MDP of 5 states, the last absorbing: action 1 advances with chance .8, a step costs .1."""

    def __init__(self) -> None:
        self.move = np.zeros((STATES, ACTIONS, STATES))  # P(s' | s, a)
        self.reward = np.zeros((STATES, ACTIONS, STATES))
        for state in range(STATES - 1):
            self.move[state, 0, state] = 1.0
            self.move[state, 1, state + 1], self.move[state, 1, state] = 0.8, 0.2
            self.reward[state] = -0.1
        self.reward[STATES - 2, 1, STATES - 1] = 1.0
        self.move[STATES - 1, :, STATES - 1] = 1.0

    def q(self, policy: np.ndarray) -> np.ndarray:
        """Return Q (S, A) of a policy from (I - gamma P) Q = R, exact up to 0.9^30."""
        reward = (self.move * self.reward).sum(axis=2).reshape(-1)
        onward = np.einsum("sat,tb->satb", self.move, policy).reshape(STATES * ACTIONS, -1)
        solved = np.linalg.solve(np.eye(STATES * ACTIONS) - DISCOUNT * onward, reward)
        return solved.reshape(STATES, ACTIONS)

    def drive(
        self, policy: np.ndarray, episodes: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, ...]:
        """Return states (n, T), actions, rewards, next states and whether the episode goes on."""
        state = np.zeros(episodes, np.int64)
        found: list[tuple[np.ndarray, ...]] = []
        for _ in range(STEPS):
            action = (rng.random(episodes) < policy[state, 1]).astype(np.int64)
            onward = self.move[state, action].cumsum(axis=1)
            following = (rng.random(episodes)[:, None] > onward).sum(axis=1)
            alive = state != STATES - 1
            found.append((state, action, self.reward[state, action, following], following, alive))
            state = following
        return tuple(np.stack(column, axis=1) for column in zip(*found, strict=True))


CHAIN = Chain()
BEHAVIOUR = np.tile([0.4, 0.6], (STATES, 1))
TARGET = np.tile([0.2, 0.8], (STATES, 1))
TRUTH = float((TARGET[0] * CHAIN.q(TARGET)[0]).sum())


def logged(episodes: int, seed: int, q: np.ndarray, policy: np.ndarray = TARGET) -> OpeEpisodes:
    state, action, reward, _, alive = CHAIN.drive(BEHAVIOUR, episodes, np.random.default_rng(seed))
    value = (policy * q).sum(axis=1)
    value[-1] = 0.0
    ratio = np.where(alive, policy[state, action] / BEHAVIOUR[state, action], 1.0)
    return OpeEpisodes(ratio, np.where(alive, reward, 0.0), value[state[:, 0]], DISCOUNT)


NO_MODEL = np.zeros((STATES, ACTIONS))


def repeated(episodes: int) -> np.ndarray:
    """Return importance-sampling estimates of 300 data sets."""
    return np.array(
        [per_decision(logged(episodes, seed, NO_MODEL), once(episodes))[0] for seed in range(300)]
    )


def test_weighted_estimate_is_consistent() -> None:
    few, many = (np.sqrt(np.mean((repeated(n) - TRUTH) ** 2)) for n in (10, 250))
    assert many < few / 2
    found = per_decision(logged(20_000, 1, NO_MODEL), once(20_000))[0]
    assert found == pytest.approx(TRUTH, abs=0.02)


def test_fqe_has_the_bias_of_its_model() -> None:
    wrong = np.where(np.arange(STATES)[:, None] == STATES - 1, 0.0, CHAIN.q(TARGET) + 0.5)
    answers = {e.estimator: e for e in _estimates(logged(4000, 2, wrong))}
    assert answers["fqe"].value == pytest.approx(TRUTH + 0.5, abs=1e-6)
    assert (answers["fqe"].low, answers["fqe"].high) == (
        None,
        None,
    )  # it would miss the bias


def test_intervals_have_nominal_coverage() -> None:
    inside = 0
    for seed in range(100):
        for answer in _estimates(logged(120, seed, NO_MODEL), resamples=300):
            if answer.estimator == "pdwis":
                assert answer.low is not None
                assert answer.high is not None
                inside += answer.low <= TRUTH <= answer.high
    assert inside >= 85


def test_weights_of_equal_policies_are_one() -> None:
    same = logged(40, 3, CHAIN.q(BEHAVIOUR), BEHAVIOUR)
    np.testing.assert_allclose(effective_episodes(same.ratio), 40.0)
    plain = observed(same, once(40))
    np.testing.assert_allclose(per_decision(same, once(40)), plain)
    assert EssGate().refusal(same) is None


def test_gate_refuses_policy_far_from_logs() -> None:
    far = np.tile([0.97, 0.03], (STATES, 1))
    away = logged(60, 4, CHAIN.q(far), far)
    answers = {e.estimator: e for e in _estimates(away)}
    assert answers["fqe"].value is not None
    assert answers["pdwis"].value is None
    assert "of 60 episodes, less than 12.0" in str(answers["pdwis"].refused)
    reach = EssGate().measure(away)[1]
    assert 0 < reach < STEPS


def test_too_few_episodes_give_their_own_reason() -> None:
    """Refuse one episode for its number: its effective sample size is 1 for any policy."""
    alone = logged(1, 3, CHAIN.q(BEHAVIOUR), BEHAVIOUR)
    answers = {e.estimator: e.refused for e in _estimates(alone)}
    assert answers["pdwis"] == "1 episode, and weights need at least 5"
    assert answers["fqe"] is None


TABULAR = FittedQConfig(iterations=40, updates=20, batch_size=512, hidden=(), layer_norm=False)
TABULAR = replace(TABULAR, learning_rate=0.03)


def rows(episodes: int, seed: int) -> tuple[Transitions, np.ndarray]:
    """Return transitions with one-hot observations, and their next states."""
    state, action, reward, following, alive = CHAIN.drive(
        BEHAVIOUR, episodes, np.random.default_rng(seed)
    )
    state, action, reward, following = (
        column[alive] for column in (state, action, reward, following)
    )
    one_hot = np.eye(STATES, dtype=np.float32)
    return Transitions(
        one_hot[state],
        action,
        reward.astype(np.float32),
        one_hot[following],
        following == STATES - 1,
    ), following


def test_fitted_q_matches_exact_values() -> None:
    seen, following = rows(600, 8)
    policy = TARGET.astype(np.float32)
    network = fitted_q(seen, policy[following], discount=DISCOUNT, config=TABULAR)
    found = values(network, np.eye(STATES, dtype=np.float32))
    np.testing.assert_allclose(found[:-1], CHAIN.q(TARGET)[:-1], atol=0.06)


def test_fitted_value_is_mean_of_rare_large_rewards() -> None:
    """Regression: with one step in ten of -10 and others of 1, the Huber loss gave .9, not -.1."""
    rows, reward = 1000, np.ones(1000, np.float32)
    reward[::10] = -10.0
    seen = Transitions(
        np.ones((rows, 2), np.float32),
        np.zeros(rows, np.int64),
        reward,
        np.ones((rows, 2), np.float32),
        np.ones(rows, np.bool_),
    )
    policy = np.ones((rows, 1), np.float32)
    network = fitted_q(seen, policy, discount=DISCOUNT, config=replace(TABULAR, iterations=10))
    assert values(network, seen.observation[:1])[0, 0] == pytest.approx(-0.1, abs=0.25)


def test_cloning_recovers_behaviour_policy() -> None:
    seen, _ = rows(600, 10)
    network = cloned_behaviour(
        seen.observation, seen.action, ACTIONS, config=replace(TABULAR, cloning_updates=400)
    )
    logits = values(network, np.eye(STATES, dtype=np.float32)[:-1])
    chance = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(chance, BEHAVIOUR[:-1], atol=0.05)


def _estimates(episodes: OpeEpisodes, *, resamples: int = 200):
    return estimate(episodes, rng=np.random.default_rng(0), resamples=resamples)
