#!/usr/bin/env bash
# The commands that trained the policies of the package, on one core. The package contains the policy of the last part,
# of the step that a comment names.
set -e

# run-rewards: the policy of step 140,000
torchmpm train --task run --algo cfp-sac --preset long --resolutions 4 --steps 160000 --seed 1 --out runs/run-rewards

# obstacle-rewards: the policy of step 150,000
torchmpm train --task obstacle --algo cfp-sac --preset long --resolutions 4 --steps 160000 --critics-first 0.01 \
    --out runs/obstacle-rewards

# run: the policies of steps 6,400 and 4,864
goal=(--task run --refine --resolutions 8 --steps 9600 --max-episode-steps 800 --success-reward 60 --eval-episodes 8)
torchmpm train --task run --resolutions 8 --steps 9600 --out runs/run
torchmpm train "${goal[@]}" --start-from runs/run --action-step 0.1 --eval-every 3200 --out runs/run-goal
torchmpm train "${goal[@]}" --start-from runs/run-goal --action-step 0.05 --eval-every 1600 --out runs/run-success

# catch: the policies of steps 12,800 and 6,400
goal=(--task catch --refine --resolutions 8 --steps 12800 --success-reward 30 --eval-every 3200 --eval-episodes 8)
torchmpm train --task catch --resolutions 8 --steps 25600 --out runs/catch
torchmpm train "${goal[@]}" --start-from runs/catch --max-episode-steps 500 --action-step 0.1 --out runs/catch-goal
torchmpm train "${goal[@]}" --start-from runs/catch-goal --max-episode-steps 600 --action-step 0.05 \
    --learning-rate 5e-4 --warmup 30 --out runs/catch-success

# shapematch
common=(--task shapematch --resolutions 32 --steps 4800)
torchmpm train "${common[@]}" --seed 1 --out runs/star
torchmpm train "${common[@]}" --start-from runs/star --refine --train-particles full --action-step 0.2 \
    --eval-every 0 --out runs/shapematch
varied=(--refine --vary 0.25 --eval-every 0)
torchmpm train "${varied[@]}" --task shapematch --resolutions 32 --start-from runs/shapematch --steps 6400 \
    --action-step 0.2 --out runs/shapematch-varied
# the same with a reward for success, from the policy that was trained under varied conditions
torchmpm train --task shapematch --resolutions 32 --start-from runs/shapematch-varied --refine --particles full \
    --train-particles full --success-reward 10 --action-step 0.1 --steps 4800 --eval-every 800 --eval-episodes 16 \
    --out runs/shapematch-success
python - <<'PYTHON'
import cfp

varied, policy = cfp.load("runs/shapematch-varied"), cfp.load("runs/shapematch-success")
for weight, other in zip(policy.parameters(), varied.parameters(), strict=True):
    weight.data = 0.4 * other.data + 0.6 * weight.data
policy.save("runs/shapematch-mean.safetensors")
PYTHON

# kick
torchmpm train --task kick --resolutions 8 --steps 38400 --seed 2 --out runs/kick-38400
torchmpm train --task kick --start-from runs/kick-38400 --refine --resolutions 8 --steps 6400 --seed 2 \
    --max-episode-steps 500 --success-reward 30 --action-step 0.05 --eval-every 1600 --eval-episodes 8 --out runs/kick

# slot: the policy of step 1,600
common=(--task slot --resolutions 8)
torchmpm train "${common[@]}" --steps 32000 --eval-every 0 --out runs/slot-32000
torchmpm train "${common[@]}" --start-from runs/slot-32000 --refine --success-reward 200 --action-step 0.05 \
    --warmup 4 --steps 6400 --eval-every 1600 --out runs/slot

# slot-success
torchmpm train "${common[@]}" --start-from runs/slot --refine --success-reward 200 --action-step 0.05 \
    --eval-every 0 --steps 4800 --seed 3 --out runs/slot-success

# grow-success with seed 0, grow with seed 1; the distilled policies are those of steps 4,096 and 6,144
common=(--task grow --refine --resolutions 8 --success-reward 200 --warmup 4 --eval-every 0)
short=(--window 40 --max-episode-steps 40 --action-step 0.05)
for seed in 0 1; do
    torchmpm train --algo mpc --task grow --termination-steps 0 --seed $seed --out runs/grow-plan-$seed
    torchmpm train --algo distill --task grow --teacher runs/grow-plan-$seed --resolutions 8 --steps 10240 \
        --max-episode-steps 45 --rollout-steps 32 --updates 160 --batch-size 64 --learning-rate 2e-3 \
        --beta-decay 0.9 --dropout 0 --seed $seed --out runs/grow-distilled-$seed
    torchmpm train "${common[@]}" "${short[@]}" --start-from runs/grow-distilled-$seed --steps 6400 --seed $seed \
        --out runs/grow-40-$seed
    torchmpm train "${common[@]}" "${short[@]}" --start-from runs/grow-40-$seed --steps 4800 --seed $((seed + 1)) \
        --out runs/grow-80-$seed
    torchmpm train "${common[@]}" "${short[@]}" --start-from runs/grow-80-$seed --steps 6400 --seed $seed \
        --vary 0.25 --out runs/grow-varied-$seed
    torchmpm train "${common[@]}" --window 32 --max-episode-steps 128 --start-from runs/grow-varied-$seed \
        --steps 12800 --seed $seed --vary 0.25 --piece-weight 20 --out runs/grow-$seed
done

# dig: the first part was stopped at step 19,200
torchmpm train --task dig --resolutions 8 --steps 25600 --eval-every 6400 --seed 1 --out runs/dig
torchmpm train "${varied[@]}" --task dig --resolutions 8 --start-from runs/dig --steps 6400 --out runs/dig-varied

# obstacle
torchmpm train --task obstacle --resolutions 8 --steps 44800 --eval-every 6400 --out runs/obstacle
torchmpm train "${varied[@]}" --task obstacle --resolutions 8 --start-from runs/obstacle --steps 9600 \
    --piece-weight 50 --out runs/obstacle-varied
