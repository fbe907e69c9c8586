"""PPO in one loop, as in CleanRL, on a batch of robots that never leaves torch."""

import torch
from torch import nn
from torch.distributions import Normal

import dittogym

torch.manual_seed(0)
NUM_ENVS, STEPS, DISCOUNT, TRACE, CLIP = 4, 8, 0.99, 0.95, 0.2
env = dittogym.TorchEnv("run", num_envs=NUM_ENVS, particles=500, substeps=10)  # small, so that this takes seconds
size = torch.Size(env.action_shape).numel()

features = nn.Sequential(nn.Conv2d(3, 16, 8, 4), nn.ReLU(), nn.Conv2d(16, 16, 4, 4), nn.ReLU(), nn.Flatten())
policy, value = nn.Linear(144, size), nn.Linear(144, 1)
log_std = nn.Parameter(torch.full((size,), -1.0))
parameters = [*features.parameters(), *policy.parameters(), *value.parameters(), log_std]
optimizer = torch.optim.Adam(parameters, lr=3e-4)


def evaluate(observation):
    hidden = features(observation / 255.0)
    return Normal(policy(hidden), log_std.exp()), value(hidden).squeeze(1)


observation, _ = env.reset(seed=0)
for iteration in range(2):
    steps = []
    for _ in range(STEPS):
        with torch.no_grad():
            distribution, estimate = evaluate(observation)
            action = distribution.sample()
            clipped = action.clamp(-1, 1).view(NUM_ENVS, *env.action_shape)
            following, reward, terminated, truncated, _ = env.step(clipped)
            reward = reward + DISCOUNT * (truncated & ~terminated) * evaluate(following)[1]  # a time limit is no end
        ended = terminated | truncated
        steps.append((observation, action, distribution.log_prob(action).sum(1), estimate, reward, ended))
        observation = env.reset(options={"reset_mask": ended})[0] if ended.any() else following
    observations, actions, old_log_prob, estimates, rewards, ends = map(torch.stack, zip(*steps, strict=True))

    with torch.no_grad():  # generalised advantage estimation
        later, advantage, advantages = evaluate(observation)[1], torch.zeros(NUM_ENVS), []
        for t in reversed(range(STEPS)):
            goes_on = (~ends[t]).float()
            advantage = rewards[t] + goes_on * DISCOUNT * (later + TRACE * advantage) - estimates[t]
            later = estimates[t]
            advantages.insert(0, advantage)
    advantages = torch.stack(advantages).flatten()
    returns = advantages + estimates.flatten()
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)

    for _ in range(4):
        distribution, estimate = evaluate(observations.flatten(0, 1))
        ratio = (distribution.log_prob(actions.flatten(0, 1)).sum(1) - old_log_prob.flatten()).exp()
        gain = torch.min(ratio * advantages, ratio.clamp(1 - CLIP, 1 + CLIP) * advantages)
        loss = -gain.mean() + 0.5 * (estimate - returns).square().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, 0.5)
        optimizer.step()
    print(f"iteration {iteration + 1}: mean reward {rewards.mean():.1f}, loss {loss.item():.3g}")
