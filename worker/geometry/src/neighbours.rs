//! Nearest points: a balanced k-d tree over an array (Bentley 1975).

use glam::DVec3;

/// Points in tree order: the middle of each range splits it along an axis.
pub(crate) struct Neighbours {
    /// Points with their index, in tree order.
    nodes: Vec<(DVec3, u32)>,
    /// Axis along which the range that a node is the middle of is split.
    axes: Vec<u8>,
}

impl Neighbours {
    /// All points must be finite.
    pub(crate) fn new(points: &[DVec3]) -> Self {
        let mut nodes: Vec<(DVec3, u32)> = points.iter().copied().zip(0..).collect();
        let mut axes = vec![0; nodes.len()];
        split(&mut nodes, &mut axes);
        Self { nodes, axes }
    }

    /// Up to `count` points nearest to `place` and nearer than `radius`, as squared distance and index, nearest
    /// first; `found` is cleared and filled.
    pub(crate) fn nearest(
        &self,
        place: DVec3,
        count: usize,
        radius: f64,
        found: &mut Vec<(f64, u32)>,
    ) {
        found.clear();
        let mut open = vec![(0, self.nodes.len(), 0.0)];
        while let Some((start, end, least)) = open.pop() {
            let limit = match found.last() {
                Some(&(farthest, _)) if found.len() == count => farthest,
                _ => radius * radius,
            };
            if start >= end || least >= limit {
                continue;
            }
            let middle = usize::midpoint(start, end);
            let (point, index) = self.nodes[middle];
            let distance = point.distance_squared(place);
            if distance < limit {
                let at = found.partition_point(|&(other, _)| other <= distance);
                found.insert(at, (distance, index));
                found.truncate(count);
            }
            let across = place[self.axes[middle] as usize] - point[self.axes[middle] as usize];
            let (left, right) = ((start, middle), (middle + 1, end));
            let (near, far) = if across < 0.0 {
                (left, right)
            } else {
                (right, left)
            };
            // The near side is looked at first, so that little of the far one is left.
            open.push((far.0, far.1, least.max(across * across)));
            open.push((near.0, near.1, least));
        }
    }
}

fn split(nodes: &mut [(DVec3, u32)], axes: &mut [u8]) {
    if nodes.is_empty() {
        return;
    }
    let (low, high) = nodes.iter().fold(
        (DVec3::INFINITY, DVec3::NEG_INFINITY),
        |(low, high), (point, _)| (low.min(*point), high.max(*point)),
    );
    let extent = high - low;
    let axis = (0..3)
        .max_by(|&a, &b| extent[a].total_cmp(&extent[b]))
        .unwrap_or(0);
    let middle = nodes.len() / 2;
    nodes.select_nth_unstable_by(middle, |(a, i), (b, j)| {
        a[axis].total_cmp(&b[axis]).then(i.cmp(j))
    });
    axes[middle] = axis as u8;
    let (left, right) = nodes.split_at_mut(middle);
    let (left_axes, right_axes) = axes.split_at_mut(middle);
    split(left, left_axes);
    split(&mut right[1..], &mut right_axes[1..]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::{prop_assert, prop_assert_eq, proptest};

    proptest! {
        #[test]
        fn finds_what_a_search_through_all_finds(
            points in proptest::collection::vec(proptest::array::uniform3(-4_i8..4), 0..60),
            place in proptest::array::uniform3(-5.0..5.0), count in 1_usize..9, radius in 0.5..9.0,
        ) {
            let points: Vec<DVec3> = points.iter().map(|p| DVec3::from_array(p.map(f64::from))).collect();
            let place = DVec3::from_array(place);
            let mut found = Vec::new();
            Neighbours::new(&points).nearest(place, count, radius, &mut found);
            let mut expected: Vec<f64> = points.iter().map(|p| p.distance_squared(place)).filter(|d| *d < radius * radius).collect();
            expected.sort_by(f64::total_cmp);
            expected.truncate(count);
            prop_assert_eq!(found.iter().map(|(d, _)| *d).collect::<Vec<_>>(), expected);
            for (distance, index) in found {
                prop_assert!((points[index as usize].distance_squared(place) - distance).abs() < 1e-12);
            }
        }
    }
}
