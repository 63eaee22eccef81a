import os
import subprocess
import sys
import time

import pytest

import i2rl.compilation
from i2rl.compilation import compile_quickly, keep_programs

PROGRAM = """
from i2rl.compilation import compile_quickly, keep_programs
print(keep_programs())
import jax, jax.numpy as jnp
jax.jit(lambda x: jnp.linalg.inv(x @ x.T) @ x)(jnp.eye(5)).block_until_ready()
print(jax.config.jax_compilation_cache_dir)
"""


def run(program=PROGRAM, **settings):
    apart = ("I2RL_CACHE", "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    environment = {name: value for name, value in os.environ.items() if name not in apart}
    return subprocess.run(
        [sys.executable, "-c", program],
        env=environment | settings,
        capture_output=True,
        text=True,
        check=True,
    )


def entries(folder):
    return [path for path in folder.rglob("*") if path.is_file()]


def test_programs_are_kept_in_the_folder_that_is_named(tmp_path):
    done = run(I2RL_CACHE=str(tmp_path))
    assert done.stderr == ""
    folder, used = done.stdout.split()
    assert folder == used
    assert folder.startswith(str(tmp_path))
    assert entries(tmp_path)


def test_programs_are_kept_in_the_user_s_cache_folder_unless_one_is_named(tmp_path):
    run(XDG_CACHE_HOME=str(tmp_path), HOME=str(tmp_path))
    assert entries(tmp_path)


def test_off_keeps_nothing(tmp_path):
    assert run(I2RL_CACHE="off", XDG_CACHE_HOME=str(tmp_path)).stdout.split() == ["None", "None"]
    assert not entries(tmp_path)


@pytest.mark.parametrize("by", ["environment", "configuration"])
def test_the_folder_that_jax_was_given_stands(by, tmp_path):
    if by == "environment":
        done = run(I2RL_CACHE="elsewhere", JAX_COMPILATION_CACHE_DIR=str(tmp_path))
    else:
        line = f"import jax\njax.config.update('jax_compilation_cache_dir', {str(tmp_path)!r})\n"
        done = run(line + PROGRAM, I2RL_CACHE="elsewhere")
    assert done.stdout.split() == ["None", str(tmp_path)]


def test_a_folder_that_cannot_be_written_is_told_of_once_and_nothing_else_changes(tmp_path):
    (tmp_path / "file").write_text("")
    done = run(
        "from i2rl.compilation import keep_programs\nkeep_programs()\n" + PROGRAM,
        I2RL_CACHE=f"{tmp_path}/file",
    )
    assert done.stdout.split() == ["None", "None"]
    assert done.stderr.count("Compiled programs are not kept") == 1
    assert len(done.stderr.splitlines()) == 1


def test_importing_the_library_does_not_switch_the_cache_on(tmp_path):
    program = "import i2rl.models, i2rl.inference, jax\nprint(jax.config.jax_compilation_cache_dir)"
    assert run(program, I2RL_CACHE=str(tmp_path)).stdout.split() == ["None"]


def test_programs_that_were_not_used_for_longest_are_removed_beyond_the_bound(tmp_path, monkeypatch):
    monkeypatch.setattr(i2rl.compilation, "_LARGEST_BYTES", 1000)
    monkeypatch.setattr(i2rl.compilation, "_PRUNED_BYTES", 500)
    for name in ("I2RL_CACHE", "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.setenv(name, "")
    monkeypatch.setenv("I2RL_CACHE", str(tmp_path))
    monkeypatch.setattr(i2rl.compilation, "_set", lambda setting, value: None)
    monkeypatch.setattr(i2rl.compilation, "_chosen", lambda setting, default: False)
    folder = keep_programs()
    now = time.time()
    for age in range(11):
        path = folder / str(age)
        path.write_bytes(bytes(100))
        os.utime(path, (now - age, now - age))
    keep_programs()
    assert {path.name for path in entries(folder)} == {"0", "1", "2", "3", "4"}


LEVEL = """
import os
from i2rl.compilation import compile_quickly
compile_quickly()
print(os.environ["XLA_FLAGS"])
import jax, jax.numpy as jnp
jax.jit(jnp.sin)(1.0).block_until_ready()
"""


def test_programs_are_compiled_quickly_unless_the_user_decides_otherwise():
    level, loops = "--xla_backend_optimization_level=1", "--xla_cpu_use_fusion_emitters=false"
    assert run(LEVEL, XLA_FLAGS="").stdout.strip() == f"{level} {loops}"
    fast = "--xla_cpu_enable_fast_math=true"
    assert run(LEVEL, XLA_FLAGS=fast).stdout.strip() == f"{fast} {level} {loops}"
    named = "--xla_backend_optimization_level=2 --xla_cpu_use_fusion_emitters=true"
    assert run(LEVEL, XLA_FLAGS=named).stdout.strip() == named


def test_a_release_that_may_not_know_a_flag_is_not_asked(monkeypatch):
    monkeypatch.setattr("i2rl.compilation.version", lambda package: "99.1.0")
    monkeypatch.setenv("XLA_FLAGS", "")
    compile_quickly()
    assert os.environ["XLA_FLAGS"] == "--xla_backend_optimization_level=1"
