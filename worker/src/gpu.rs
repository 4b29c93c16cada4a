//! Finds out whether this machine's GPU can be used, without risk for the process that asks.
//!
//! The binary links libtorch's CPU library alone. Where the machine has an NVIDIA device and `libtorch_cuda.so` lies
//! beside the CPU library (or `IGN_LIBTORCH_CUDA` names it), a child process of this program loads it first
//! (`LD_PRELOAD`) and computes something. Only when that works do later processes load it; otherwise one line says
//! why not, and the CPU is used. A broken driver can thus end the probe, never a bake. `IGN_DEVICE=cpu` skips all of
//! this.

use std::ffi::OsString;
use std::io::Read;
use std::num::NonZero;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde_json::json;
use tch::{Kind, Tensor};

use crate::output;

/// Set in processes whose device is settled.
const SETTLED: &str = "IGN_DEVICE_SETTLED";
/// Loading the CUDA library for the first time reads gigabytes.
const PROBE_LIMIT: Duration = Duration::from_mins(3);

/// What bakes run on, and the environment in which they do.
#[derive(Debug)]
pub(crate) struct Gpu {
    /// For people: `NVIDIA H200`, `cpu`.
    pub(crate) name: String,
    pub(crate) envs: Vec<(OsString, OsString)>,
}

/// Brings up the device and the threads; how many these are.
pub(crate) fn prepare(threads: Option<NonZero<usize>>) -> Result<usize> {
    enable()?;
    let threads = match threads {
        Some(threads) => threads.get(),
        None => std::thread::available_parallelism()?.get(),
    };
    ign_nets::device::start_threads(threads)?;
    Ok(threads)
}

/// Settles the device for child processes of this one.
pub(crate) fn probe() -> Gpu {
    let settled = (OsString::from(SETTLED), OsString::from("1"));
    let cpu = Gpu {
        name: "cpu".to_owned(),
        envs: vec![settled.clone()],
    };
    let Some(library) = cuda_library() else {
        return cpu;
    };
    let envs = vec![settled, ("LD_PRELOAD".into(), library.clone().into())];
    match probe_with(&envs) {
        Ok(device) if device.starts_with("cuda") => Gpu {
            name: model().unwrap_or(device),
            envs,
        },
        Ok(_) => cpu,
        Err(error) => {
            let library = library.display();
            output::say(&format!(
                "the GPU cannot be used, going on with the CPU: {library}: {error:#}"
            ));
            cpu
        }
    }
}

/// Starts this process again with the CUDA library when that is of use; otherwise just returns.
pub(crate) fn enable() -> Result<()> {
    if std::env::var_os(SETTLED).is_some() {
        return Ok(());
    }
    let gpu = probe();
    if gpu.envs.len() < 2 {
        return Ok(());
    }
    let error = Command::new(std::env::current_exe()?)
        .args(std::env::args_os().skip(1))
        .envs(gpu.envs)
        .exec();
    Err(error).context("cannot start again with the GPU's library")
}

/// In the probe's process: computes something on the device and names it.
pub(crate) fn check() -> Result<String> {
    check_on(ign_nets::select_device())
}

fn check_on(device: tch::Device) -> Result<String> {
    let sum = Tensor::f_ones([64, 64], (Kind::Float, device))
        .and_then(|ones| ones.f_matmul(&ones))
        .and_then(|product| product.f_sum(Kind::Float))
        .and_then(f64::try_from)
        .context("the device does not compute")?;
    ensure!(
        (sum - 262_144.0).abs() < 1.0,
        "the device computes wrongly: {sum}"
    );
    Ok(ign_nets::device::name(device))
}

/// What bakes run on, for people: a list of `{name, state, detail, hint}`.
pub(crate) fn report() -> serde_json::Value {
    let check = |name, state, detail: String, hint| json!({"name": name, "state": state, "detail": detail, "hint": hint});
    let torch = match check_on(tch::Device::Cpu) {
        Ok(device) => check("torch", "ok", format!("computes on the {device}"), None),
        Err(error) => check(
            "torch",
            "failed",
            format!("{error:#}"),
            Some("run `make setup`"),
        ),
    };
    let unused = |detail: &str| ("ok", format!("{detail}; bakes run on the CPU"), None);
    let (state, detail, hint) = if !Path::new("/dev/nvidiactl").exists() {
        unused("no NVIDIA device here")
    } else if std::env::var_os("IGN_DEVICE").is_some_and(|device| device == "cpu") {
        unused("IGN_DEVICE=cpu")
    } else {
        let model = model().unwrap_or_else(|| "an NVIDIA device".to_owned());
        match cuda_library() {
            None => (
                "warn",
                format!("{model} is there, but no libtorch_cuda.so; bakes run on the CPU"),
                Some(
                    "put the full wheel's libraries beside libtorch_cpu.so, or name it by IGN_LIBTORCH_CUDA",
                ),
            ),
            Some(library) => {
                let envs = [
                    (OsString::from(SETTLED), OsString::from("1")),
                    ("LD_PRELOAD".into(), library.into()),
                ];
                match probe_with(&envs) {
                    Ok(device) if device.starts_with("cuda") => {
                        ("ok", format!("{model} computes ({device})"), None)
                    }
                    Ok(device) => (
                        "warn",
                        format!("{model} is there, but torch takes the {device}"),
                        Some("look at the driver: nvidia-smi"),
                    ),
                    Err(error) => (
                        "warn",
                        format!("{model} cannot be used, bakes run on the CPU: {error:#}"),
                        Some("look at the driver: nvidia-smi"),
                    ),
                }
            }
        }
    };
    json!([torch, check("gpu", state, detail, hint)])
}

fn probe_with(envs: &[(OsString, OsString)]) -> Result<String> {
    let mut probe = Command::new(std::env::current_exe()?)
        .arg("device")
        .envs(envs.iter().map(|(name, value)| (name, value)))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let started = Instant::now();
    let status = loop {
        if let Some(status) = probe.try_wait()? {
            break status;
        }
        if started.elapsed() > PROBE_LIMIT {
            probe.kill().and_then(|()| probe.wait())?;
            anyhow::bail!("no answer within {} s", PROBE_LIMIT.as_secs());
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    let read = |pipe: Option<&mut dyn Read>| -> Result<String> {
        let mut bytes = Vec::new();
        if let Some(pipe) = pipe {
            pipe.take(4000).read_to_end(&mut bytes)?;
        }
        Ok(String::from_utf8_lossy(&bytes).trim().to_owned())
    };
    let complaint = read(probe.stderr.as_mut().map(|pipe| pipe as &mut dyn Read))?;
    ensure!(
        status.success(),
        "{status}: {}",
        complaint.lines().last().unwrap_or_default()
    );
    read(probe.stdout.as_mut().map(|pipe| pipe as &mut dyn Read))
}

/// The library to load, where a GPU and the library exist.
fn cuda_library() -> Option<PathBuf> {
    if std::env::var_os("IGN_DEVICE").is_some_and(|device| device == "cpu")
        || !Path::new("/dev/nvidiactl").exists()
    {
        return None;
    }
    if let Some(library) = std::env::var_os("IGN_LIBTORCH_CUDA") {
        return Some(library.into());
    }
    let maps = std::fs::read_to_string("/proc/self/maps").ok()?;
    let cpu = maps
        .lines()
        .filter_map(|line| line.find('/').map(|start| &line[start..]))
        .find(|path| path.ends_with("/libtorch_cpu.so"))?;
    let library = Path::new(cpu).with_file_name("libtorch_cuda.so");
    library.exists().then_some(library)
}

/// The GPU's model, as its driver names it.
fn model() -> Option<String> {
    let gpu = std::fs::read_dir("/proc/driver/nvidia/gpus")
        .ok()?
        .next()?
        .ok()?;
    let text = std::fs::read_to_string(gpu.path().join("information")).ok()?;
    text.lines()
        .find_map(|line| line.strip_prefix("Model:"))
        .map(|model| model.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_report_says_what_bakes_run_on() {
        let report = report();
        assert_eq!(report[0]["name"], "torch");
        assert_eq!(report[0]["state"], "ok", "{report}");
        assert_eq!(report[1]["name"], "gpu");
    }

    #[test]
    fn the_chosen_device_computes() {
        assert!(["cpu", "cuda:0"].contains(&check().unwrap().as_str()));
    }
}
