//! What training views show, kept between steps: in memory within the recipe's budget, beyond it on disk.
//!
//! A view is computed once, whatever the budget, and where it lies changes nothing that is trained. Files are mapped, so that
//! memory which the machine can spare still serves them, and have no name: they vanish with the process, however it ends.

use std::path::{Path, PathBuf};

use tch::{Device, Kind, Tensor};

use crate::{BakeError, io};

/// Views by number, in half precision.
#[derive(Debug)]
pub(crate) struct ViewStore {
    dir: PathBuf,
    budget_left_bytes: u64,
    on_disk_bytes: u64,
    device: Device,
    /// [H, W, C] f16 each: a window's rows lie together.
    views: Vec<Tensor>,
}

impl ViewStore {
    /// Nothing yet. At most `budget_bytes` will be kept on `device`, the rest in the folder `dir`.
    pub(crate) fn new(dir: &Path, budget_bytes: u64, device: Device) -> Self {
        Self {
            dir: dir.to_owned(),
            budget_left_bytes: budget_bytes,
            on_disk_bytes: 0,
            device,
            views: Vec::new(),
        }
    }

    /// Number of views.
    pub(crate) fn len(&self) -> usize {
        self.views.len()
    }

    /// Bytes that lie on disk.
    pub(crate) fn on_disk_bytes(&self) -> u64 {
        self.on_disk_bytes
    }

    /// Keeps a view's planes, each [1, C, H, W] of one size.
    pub(crate) fn push(&mut self, planes: &[Tensor]) -> Result<(), BakeError> {
        let halves: Vec<Tensor> = planes.iter().map(|p| p.to_kind(Kind::Half)).collect();
        let view = Tensor::cat(&halves, 1).squeeze_dim(0);
        let view = view.permute([1, 2, 0]).contiguous();
        let bytes = (view.numel() * Kind::Half.elt_size_in_bytes()) as u64;
        let kept = if bytes <= self.budget_left_bytes {
            self.budget_left_bytes -= bytes;
            view
        } else {
            self.on_disk_bytes += bytes;
            self.on_disk(&view)?
        };
        self.views.push(kept);
        Ok(())
    }

    /// Height and width of a view.
    pub(crate) fn size(&self, view: usize) -> (i64, i64) {
        let size = self.views[view].size();
        (size[0], size[1])
    }

    /// [B, C, h, w] f32: windows of one size, each of a view from a row and a column on.
    pub(crate) fn windows(&self, from: &[(usize, i64, i64)], (h, w): (i64, i64)) -> Tensor {
        let windows: Vec<Tensor> = from
            .iter()
            .map(|&(view, y, x)| {
                let window = self.views[view].narrow(0, y, h).narrow(1, x, w);
                window.to_device(self.device)
            })
            .collect();
        Tensor::stack(&windows, 0)
            .to_kind(Kind::Float)
            .permute([0, 3, 1, 2])
            .contiguous()
    }

    fn on_disk(&self, view: &Tensor) -> Result<Tensor, BakeError> {
        let path = self.dir.join("view.f16");
        let mut bytes = vec![0; view.numel() * Kind::Half.elt_size_in_bytes()];
        let on_cpu = view.to_device(Device::Cpu);
        on_cpu.copy_data_u8(&mut bytes, on_cpu.numel());
        // Written, not stored through the mapping: a full disk is then an error, not a signal.
        std::fs::write(&path, bytes).map_err(io(&path))?;
        let mapped = Tensor::f_from_file(
            &path.to_string_lossy(),
            false,
            view.numel() as i64,
            (Kind::Half, Device::Cpu),
        )
        .map_err(ign_nets::NetError::from)?;
        std::fs::remove_file(&path).map_err(io(&path))?;
        Ok(mapped.view(view.size().as_slice()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    /// Values that half precision holds exactly.
    fn planes(view: i64) -> [Tensor; 2] {
        let ramp = Tensor::arange(3 * 5 * 7, FLOAT).view([1, 3, 5, 7]) + view * 100;
        [ramp.narrow(1, 0, 1), ramp.narrow(1, 1, 2)]
    }

    #[test]
    fn a_view_is_the_same_wherever_it_lies() {
        let dir = tempfile::tempdir().expect("a folder");
        let one_view = 3 * 5 * 7 * 2;
        let filled = |budget_bytes| {
            let mut store = ViewStore::new(dir.path(), budget_bytes, Device::Cpu);
            for view in 0..5 {
                store.push(&planes(view)).expect("a place");
            }
            store
        };
        let (memory, both, disk) = (filled(1 << 20), filled(2 * one_view + 1), filled(0));
        assert_eq!(memory.on_disk_bytes(), 0);
        assert_eq!(both.on_disk_bytes(), 3 * one_view);
        assert_eq!(disk.on_disk_bytes(), 5 * one_view);
        let left = std::fs::read_dir(dir.path()).expect("a folder").count();
        assert_eq!(left, 0, "files have no name");

        let from = [(0, 1, 2), (4, 0, 3), (2, 2, 0)];
        let windows = memory.windows(&from, (3, 4));
        assert_eq!(windows.size(), [3, 3, 3, 4]);
        let [first, rest] = planes(4);
        let whole = Tensor::cat(&[first, rest], 1);
        assert_eq!(windows.get(1), whole.narrow(2, 0, 3).narrow(3, 3, 4).get(0));
        for store in [&both, &disk] {
            assert_eq!((store.len(), store.size(3)), (5, (5, 7)));
            assert_eq!(store.windows(&from, (3, 4)), windows);
        }
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_an_error() {
        let mut store = ViewStore::new(Path::new("/no/such/folder"), 0, Device::Cpu);
        assert!(matches!(store.push(&planes(0)), Err(BakeError::Io { .. })));
    }
}
