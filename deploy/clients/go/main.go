// Drives the robot forward for two seconds and prints where it is: `go run . [ADDRESS [TOKEN]]`.
package main

import (
	"context"
	"encoding/json"
	"fmt"
	"log"
	"net/http"
	"os"
	"strings"
	"sync/atomic"
	"time"

	"github.com/coder/websocket"
	"github.com/coder/websocket/wsjson"
)

const period = 50 * time.Millisecond

// The newest beat of the robot, by which it knows how old a command is.
var beat atomic.Pointer[json.RawMessage]

type message struct {
	Key     string
	Value   json.RawMessage
	Refused string
	Reason  string
}

type odometry struct {
	Pose struct {
		Pose struct{ Position struct{ X, Y float64 } }
	}
	Twist struct {
		Twist struct{ Linear struct{ X float64 } }
	}
}

func main() {
	address, options := "http://127.0.0.1:8080", &websocket.DialOptions{}
	if len(os.Args) > 1 {
		address = os.Args[1]
	}
	if len(os.Args) > 2 {
		options.HTTPHeader = http.Header{"Authorization": {"Bearer " + os.Args[2]}}
	}
	ctx := context.Background()
	socket, _, err := websocket.Dial(ctx, strings.TrimSuffix(strings.Replace(address, "http", "ws", 1), "/")+"/ws", options)
	if err != nil {
		log.Fatal(err)
	}
	socket.SetReadLimit(1 << 20)
	go show(ctx, socket)
	say(ctx, socket, map[string]any{"subscribe": "beat"})
	say(ctx, socket, map[string]any{"subscribe": "odom", "rate": 10})
	for beat.Load() == nil {
		time.Sleep(10 * time.Millisecond)
	}
	drive(ctx, socket, 0, 100*time.Millisecond) // a zero arms this sender
	drive(ctx, socket, 0.2, 2*time.Second)
	drive(ctx, socket, 0, time.Second)
	socket.Close(websocket.StatusNormalClosure, "")
}

func say(ctx context.Context, socket *websocket.Conn, what any) {
	if err := wsjson.Write(ctx, socket, what); err != nil {
		log.Fatal(err)
	}
}

func drive(ctx context.Context, socket *websocket.Conn, speed float64, lasting time.Duration) {
	for end := time.Now().Add(lasting); time.Now().Before(end); time.Sleep(period) {
		say(ctx, socket, map[string]any{
			"cmd":  map[string]float64{"linear_x": speed, "angular_z": 0},
			"echo": beat.Load(),
		})
	}
}

func show(ctx context.Context, socket *websocket.Conn) {
	for {
		var said message
		if err := wsjson.Read(ctx, socket, &said); err != nil {
			return
		}
		if said.Refused != "" {
			log.Printf("%s was refused: %s", said.Refused, said.Reason)
		}
		if said.Key == "beat" {
			beat.Store(&said.Value)
		}
		if said.Key == "odom" {
			var value odometry
			if err := json.Unmarshal(said.Value, &value); err != nil {
				log.Fatal(err)
			}
			at := value.Pose.Pose.Position
			speed := value.Twist.Twist.Linear.X
			fmt.Printf("x %.3f m, y %.3f m, %.3f m/s\n", at.X, at.Y, speed)
		}
	}
}
