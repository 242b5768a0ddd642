/** Types of topics that a headset sends and shows. */

/** Kinds of what hands and head do → the type of their topic. */
export const POSE_TYPES = {
  head: "geometry_msgs/msg/PoseStamped",
  left: "geometry_msgs/msg/PoseStamped",
  right: "geometry_msgs/msg/PoseStamped",
  leftHand: "geometry_msgs/msg/PoseArray",
  rightHand: "geometry_msgs/msg/PoseArray",
  joy: "sensor_msgs/msg/Joy",
};

/** Types of topics → how they are shown. */
export const SHOWN = {
  "sensor_msgs/msg/CompressedImage": "picture",
  "sensor_msgs/msg/Image": "picture",
  "geometry_msgs/msg/PoseStamped": "pose",
  "geometry_msgs/msg/PoseWithCovarianceStamped": "pose",
  "nav_msgs/msg/Odometry": "pose",
  "sensor_msgs/msg/LaserScan": "scan",
  "sensor_msgs/msg/PointCloud2": "cloud",
  "nav_msgs/msg/OccupancyGrid": "map",
  "tf2_msgs/msg/TFMessage": "frames",
  "sensor_msgs/msg/JointState": "joints",
  "sensor_msgs/msg/BatteryState": "battery",
};
